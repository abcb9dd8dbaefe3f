"""Reproduction of the paper: stored experiments, the claims that rest on them, and one page."""
