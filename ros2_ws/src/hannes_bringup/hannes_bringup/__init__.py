"""Starts it all: launch files, configuration and the hannes command."""

__version__ = "0.1.0"
