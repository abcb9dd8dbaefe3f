"""The report on a run, and the comparison of a run with the timing model."""
