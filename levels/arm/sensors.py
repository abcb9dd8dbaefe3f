"""Simulated sensors: encoders of finite resolution, and a force/torque sensor at the wrist."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array
from rack.levels.compiled import compiled, compiled_for
from rack.levels.robot.limits import EDGE_TIMING_S, Encoders
from rack.levels.robot.wrist import Wrist

AXES = 6
WRIST_SEED_OFFSET = 0x57524953
"""Added to the seed, so that the wrist sensor and the encoders have different noise."""


class CoarseSensors:
    """Simulated encoders, which add noise to the true state and round it to their resolution.

    Velocities come from the drive, which times the encoder's edges. Their resolution and noise
    equal the values for positions divided by `EDGE_TIMING_S`. The noise of a tick is always the
    same, even on a restarted board or when sampled twice.
    """

    def __init__(self, encoders: Encoders, seed: int) -> None:
        per_second = np.array([[1.0], [1.0 / EDGE_TIMING_S]])
        self._sensors = seed, encoders.noise * per_second, encoders.resolution * per_second
        self._sense = sense_coarsely.load_machine_code()

    def sample(self, position: Array, velocity: Array, tick: int) -> Array:
        """Return the sensed positions in rad and velocities in rad/s, (2, joints).

        Args:
            position: True positions, (joints,), rad.
            velocity: True velocities, (joints,), rad/s.
            tick: Tick of the sample, which determines the noise.
        """
        sample = np.array((position, velocity))
        self._sense(sample, tick, *self._sensors)
        return sample


class WristSensor:
    """Simulated wrist sensor, which adds noise to MuJoCo's values and clips them to its range.

    It measures force and torque between the flange and everything beyond it, due to contact, weight
    and inertia. MuJoCo reports them as force and torque of the parent on the child, in the frame of
    the site. For a tool at rest without contact, the measured force is its weight, directed
    upwards. It is smaller while the tool presses down on a table. The noise of a tick is always the
    same, even on a restarted board or when sampled twice.
    """

    def __init__(self, wrist: Wrist, data: mujoco.MjData, seed: int) -> None:
        self._numbers = data.sensordata
        self._places = wrist.addresses
        self._range = np.repeat(wrist.range, 3)
        noise = np.repeat(wrist.noise, 3)
        self._sensors = seed + WRIST_SEED_OFFSET, np.stack((noise, noise)), np.zeros((2, AXES))
        self._sense = sense_coarsely.load_machine_code()

    def sample(self, tick: int) -> Array:
        """Return force in N and torque in N m, in the sensor's frame, (6,).

        The values are from the last simulation step before `tick`.
        """
        # The second row is not used.
        sample = np.zeros((2, AXES))
        sample[0] = self._numbers[self._places]
        self._sense(sample, tick, *self._sensors)
        return np.asarray(np.clip(sample[0], -self._range, self._range))


@compiled_for("f8[:,::1], i8, i8, f8[:,::1], f8[:,::1]")
def sense_coarsely(sample: Array, tick: int, seed: int, noise: Array, step: Array) -> None:
    """Add noise to a true state and round it, in place.

    Args:
        sample: True state, (2, joints); receives the sample.
        tick: Tick of the sample.
        seed: Seed of the noise.
        noise: Standard deviation, (2, joints).
        step: Resolution, (2, joints). 0 where values are not rounded.
    """
    joints = sample.shape[1]
    chance = draw_uniform(seed, tick, 2 * joints)
    for joint in range(joints):
        # Box and Muller's method makes two independent normal numbers from two uniform numbers.
        length = math.sqrt(-2.0 * math.log(chance[joint]))
        angle = 2.0 * math.pi * chance[joints + joint]
        sample[0, joint] += noise[0, joint] * length * math.cos(angle)
        sample[1, joint] += noise[1, joint] * length * math.sin(angle)
        for row in range(2):
            if step[row, joint] > 0.0:
                sample[row, joint] = (
                    np.rint(sample[row, joint] / step[row, joint]) * step[row, joint]
                )


@compiled_for("i8, i8, i8")
def draw_uniform(seed: int, tick: int, count: int) -> Array:
    """Return uniform random numbers between 0 and 1, both excluded.

    The same arguments always give the same numbers.

    Args:
        seed: Seed.
        tick: Tick for which the numbers are drawn.
        count: Number of values to return.
    """
    bits = mix_bits(np.zeros(count, dtype=np.uint64) + np.uint64(seed))
    bits = mix_bits(mix_bits(bits + np.uint64(tick)) + np.arange(count).astype(np.uint64))
    return ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53


@compiled
def mix_bits(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix the bits of each number with SplitMix64 (Steele, Lea and Flood, OOPSLA 2014)."""
    bits = bits + np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))
