"""What the nodes share: topic names and QoS, message conversions, parameters, lock-step, the main loop of a node."""

__version__ = "0.1.0"
