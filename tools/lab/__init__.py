"""Measurements of this project and the reproduction of the paper.

Only the commands of the lab import these packages.
"""
