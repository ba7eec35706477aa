"""Recorded closures: bag to Recording, crash-safe recording, playback and recovery."""

__version__ = "0.1.0"
