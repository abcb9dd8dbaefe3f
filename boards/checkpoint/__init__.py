"""Checkpoints: the whole state of a rack in lockstep between two ticks, in one file."""
