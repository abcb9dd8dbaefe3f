"""Commanding a rack that runs: its levels, what they can be told, and their answers."""
