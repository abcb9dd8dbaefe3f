"""Fault steps: how injected faults corrupt the samples, motors and commands of a driven device.

A level lists in `Executor.faults` the classes of steps that it implements. Every fault kind with a
step of such a class can then affect the level, so a new kind requires no change in the level. The
steps below belong to the project's own fault kinds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Key = tuple[str, int, int, int]
Sample = Any
"""A `rack.levels.arm.Sensed`. It is not imported because that would import MuJoCo."""

STUCK_SENSOR_ERROR = 1e-2
"""Error above which a stuck sensor must be detected, in rad and rad/s.

While a joint creeps, the error of its stuck sensor grows slowly and need not be detected earlier.
"""


class Fault(NamedTuple):
    """A fault injected into the arm, or into another device that a level drives."""

    kind: str  # name, such as "sensor-nan"
    parameters: Mapping[str, float]  # by name
    seed: int  # for its random numbers
    since: int  # tick at which it began
    step: object  # carries out the fault; its class is in `Executor.faults`

    def mark_joints(self, count: int) -> NDArray[np.bool_]:
        """Return a mask of the affected joints of a device with `count` joints."""
        # The index of the joint, or -1 for all joints.
        joint = self.parameters.get("joint", -1)
        return np.asarray((np.arange(count) == joint) | (joint < 0))


@dataclass(frozen=True)
class ActiveFault:
    """An injected fault that is active."""

    place: int  # index among the injected faults
    fault: Fault
    joints: NDArray[np.bool_]  # (joints,), True for joints that the fault affects
    every: int  # length of the level's cycle in ticks
    # The sample with which each active fault began, by `key`. All active faults share this dict.
    first_samples: dict[Key, Sample]

    @cached_property
    def key(self) -> Key:
        """Identity of the fault. It stays the same when other faults begin or end."""
        return (self.fault.kind, self.fault.seed, self.fault.since, int(self.joints.argmax()))

    def __getitem__(self, parameter: str) -> float:
        """Return the value of the fault's parameter of this name."""
        return self.fault.parameters[parameter]

    def recall_first_sample(self, sample: Sample) -> Sample:
        """Return the sample with which the fault began.

        The first call stores a copy of `sample`, which all calls return.
        """
        if self.key not in self.first_samples:
            copy = sample._replace(position=sample.position.copy(), velocity=sample.velocity.copy())
            self.first_samples[self.key] = copy
        return self.first_samples[self.key]


@dataclass(frozen=True)
class SensorStep:
    """Fault step that corrupts a sample.

    `act` returns the corrupted sample and a verdict on it: True if its error is large enough that
    it must be detected, False if it is smaller, None if there is no error. The detection bound
    counts from the first sample with True.
    """

    act: Callable[[Sample, ActiveFault], tuple[Sample, bool | None]]


@dataclass(frozen=True)
class MotorStep:
    """Fault step that weakens motors.

    `part` returns the fraction of its torque limit that a motor still provides, 0 to 1.
    """

    part: Callable[[ActiveFault], float]


@dataclass(frozen=True)
class CommandStep:
    """Fault step that corrupts the commanded torques.

    `act` takes torques and limits, N m, and returns torques, (joints,).
    """

    act: Callable[[Array, Array, ActiveFault], Array]


@dataclass(frozen=True)
class TendonStep:
    """Fault step that tears a tendon of a hand, which then has no tension.

    Its parameters are `joint` and `side` (0 for the flexor, 1 for the extensor).
    """


ARM_STEPS = (SensorStep, MotorStep, CommandStep)
"""Classes of steps that act on an arm, as `Executor.faults` names them."""


def set_position_nan(sample: Sample, fault: ActiveFault) -> tuple[Sample, bool]:
    """Replace the positions of the affected joints by NaN."""
    return sample._replace(position=np.where(fault.joints, np.nan, sample.position)), True


def bias_position(sample: Sample, fault: ActiveFault) -> tuple[Sample, bool]:
    """Add the fault's `size`, in rad, to the positions of the affected joints."""
    return sample._replace(position=sample.position + fault["size"] * fault.joints), True


def add_position_noise(sample: Sample, fault: ActiveFault) -> tuple[Sample, bool]:
    """Add noise to the affected positions. Its standard deviation is the fault's `size`, in rad."""
    # With the tick in the seed, a restarted board draws the same numbers.
    generator = np.random.default_rng((fault.fault.seed, sample.tick))
    noise = fault["size"] * generator.standard_normal(len(fault.joints))
    return sample._replace(position=sample.position + noise * fault.joints), True


def repeat_last_sample(sample: Sample, fault: ActiveFault) -> tuple[Sample, bool]:
    """Return the sample with which the fault began, as if no new one had arrived since then.

    Its tick is that of one cycle earlier.
    """
    first = fault.recall_first_sample(sample)
    return first._replace(tick=first.tick - fault.every), True


def freeze_sample(sample: Sample, fault: ActiveFault) -> tuple[Sample, bool | None]:
    """Replace the affected positions and velocities by their values when the fault began."""
    first = fault.recall_first_sample(sample)
    truth = (sample.position, sample.velocity)
    stuck = np.where(fault.joints, (first.position, first.velocity), truth)
    off = np.abs(stuck - truth)
    must_be_found = bool((off > STUCK_SENSOR_ERROR).any()) if off.any() else None
    return sample._replace(position=stuck[0], velocity=stuck[1]), must_be_found


def set_torque_nan(torque: Array, limits: Array, fault: ActiveFault) -> Array:
    """Replace all torques by NaN."""
    return np.full_like(torque, np.nan)


def exceed_torque(torque: Array, limits: Array, fault: ActiveFault) -> Array:
    """Replace each torque by `factor` times its limit, with the same sign."""
    return fault["factor"] * np.copysign(limits, torque)
