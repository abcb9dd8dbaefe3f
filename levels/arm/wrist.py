"""The wrist sensor of the simulated arm.

It gives the force and torque between the flange and all that hangs on it: of a contact, of the
weight, and of the inertia. MuJoCo gives them as those of the parent on the child, in the frame of
the site: a tool at rest that nothing touches reads its weight upwards, and one that presses down on
a table reads less than that.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from rack.levels.algebra import Array
from rack.levels.arm.drives import uniform

if TYPE_CHECKING:
    from rack.levels.robot.wrist import Wrist

AXES = 6
STREAM = 0x57524953
"""Added to the seed: the noise of the wrist sensor is not that of the encoders."""


class WristSensor:
    """Samples the simulated sensor: MuJoCo's numbers, noise, then the end of the range.

    The noise of a tick is always the same, even on a restarted board or when sampled twice.
    """

    def __init__(self, wrist: Wrist, data: mujoco.MjData, seed: int) -> None:
        self._numbers = data.sensordata
        self._places = wrist.addresses
        self._noise = np.repeat(wrist.noise, 3)
        self._range = np.repeat(wrist.range, 3)
        self._seed = seed + STREAM
        self._uniform = uniform.load()

    def sample(self, tick: int) -> Array:
        """Return force, N, and torque, N m, in the sensor's frame, (6,), of the last step before
        `tick`."""
        sample = self._numbers[self._places]
        if self._noise[0] > 0.0:
            chance = self._uniform(self._seed, tick, 2 * AXES)
            for axis in range(AXES):
                # Box and Muller, of which the second number is not used.
                length = math.sqrt(-2.0 * math.log(chance[axis]))
                angle = 2.0 * math.pi * chance[AXES + axis]
                sample[axis] += self._noise[axis] * length * math.cos(angle)
        return np.asarray(np.clip(sample, -self._range, self._range))
