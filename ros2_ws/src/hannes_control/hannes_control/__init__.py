"""The double PID of the motor and the way from surface EMG to a reference, with their nodes."""

__version__ = "0.1.0"
