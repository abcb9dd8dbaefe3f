"""Benchmarks: costs of the backplane, of recording and of partitions on this machine."""
