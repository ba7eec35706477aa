"""The simulated hand: mechanics, motor, physical effects, objects to grasp, and the hand_sim node."""

__version__ = "0.1.0"
