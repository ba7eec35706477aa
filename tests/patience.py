"""How long the tests wait for what takes seconds."""

PATIENCE = 120.0
"""s.  Whether something happens at all is tested, never how soon: on a machine that others keep busy a node has been
seen to need 40 s for its start."""
