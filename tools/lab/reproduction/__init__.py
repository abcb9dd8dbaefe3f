"""Reproduction of the paper: stored experiments, the claims that depend on them, and one page."""
