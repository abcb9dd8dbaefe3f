"""Faults: the kinds there are, how they are asked for, and how they are really done."""
