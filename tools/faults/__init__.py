"""Faults of a rack: injection while it runs, and verdicts from its events."""
