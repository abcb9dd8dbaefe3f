"""Names of racks. A rack and its segment have the same name."""

RACK_NAME = "[a-z0-9][a-z0-9_-]{0,39}"
"""Regular expression of a valid name."""
