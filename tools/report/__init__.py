"""A run judged: its report, and its comparison with the timing model."""
