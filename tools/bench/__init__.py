"""Benchmarks: what the backplane costs on this machine."""
