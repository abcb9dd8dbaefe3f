"""A run against the timing model: what its cycles took, which equation each of them broke, and what ran beside it."""
