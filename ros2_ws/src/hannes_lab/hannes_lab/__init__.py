"""Compare the model with recorded closures, diagnose what it lacks, add it, and report."""

__version__ = "0.1.0"
