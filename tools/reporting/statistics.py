"""Distributions of times as the reports give them."""

from __future__ import annotations

import numpy as np

PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99_9": 99.9}
Distribution = dict[str, float]


def distribution(values: np.ndarray) -> Distribution | None:
    """Return min, p50, p99, p99.9 and max of values of any unit, shape (n,); None when there are none."""
    if not len(values):
        return None
    found = {"min": float(values.min())}
    found |= {name: float(np.percentile(values, percent)) for name, percent in PERCENTILES.items()}
    return {name: round(value, 6) for name, value in (found | {"max": float(values.max())}).items()}
