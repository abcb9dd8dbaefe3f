"""Joint sensors with the resolution and the noise of the `[robot.sensors]` table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.levels.limits import EDGE_TIMING_S, Encoders

Array = NDArray[np.float64]


class CoarseSensors:
    """Samples positions and velocities of the joints: noise on the truth, then the nearest step of the encoder.

    Velocities are the drive's, which times the encoder's edges: as coarse, and as noisy, as positions over
    `EDGE_TIMING_S`. The noise of a tick is always the same: a board that starts anew, and a second look, see it again.
    """

    def __init__(self, encoders: Encoders, seed: int) -> None:
        self._seed = seed
        per_second = np.array([[1.0], [1.0 / EDGE_TIMING_S]])
        self._noise, self._step = encoders.noise * per_second, encoders.resolution * per_second
        self._noisy, self._stepped = bool(encoders.noise.any()), self._step > 0.0
        self._per_step = 1.0 / np.where(self._stepped, self._step, 1.0)

    def sample(self, position: Array, velocity: Array, tick: int) -> Array:
        """Return (2, joints): positions, rad, and velocities, rad/s, of a tick as sensed."""
        sample = np.array((position, velocity))
        if self._noisy:
            sample += self._noise * np.random.default_rng((self._seed, tick)).standard_normal(sample.shape)
        steps = np.rint(sample * self._per_step)
        steps *= self._step
        np.copyto(sample, steps, where=self._stepped)
        return sample
