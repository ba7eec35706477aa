"""Void, rigid or soft: the classifier of the grasped object and its node."""

__version__ = "0.1.0"
