"""Most effects that a diagnosis names, unless the user says otherwise."""

MAX_EFFECTS = 3
MAX_GREEDY = 7
"""By the smallest set that explains all, and one after another."""
