"""A path as it travels in messages."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Path(NamedTuple):
    """Waypoints (k, joints), in rad, and the length, in rad, over which each corner is rounded, (k,)."""

    waypoints: Array
    blend: Array

    @property
    def end(self) -> Array:
        """The last waypoint."""
        return np.asarray(self.waypoints[-1])
