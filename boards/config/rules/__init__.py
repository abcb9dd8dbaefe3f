"""The rules of a config, a file a subject."""
