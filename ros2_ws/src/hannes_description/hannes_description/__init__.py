"""What the Hannes hand is: parameters with provenance, joints, signals, geometry. Imports no other Hannes package."""

__version__ = "0.1.0"
