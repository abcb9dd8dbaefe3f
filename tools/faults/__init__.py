"""Faults in a rack: injected while it runs, found again in its events, and judged."""
