"""Report on a run, and its comparison with the timing model."""
