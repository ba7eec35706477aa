"""The simulated hand: mechanics, motor, physical effects, objects to grasp, and the hand_sim node."""

__version__ = "0.1.0"

from ._compile_cache import use_source_keyed_cache

use_source_keyed_cache()
