"""Faults of what a level drives: the steps that spoil its samples, its motors and its commands.

A level lists in `Executor.faults` the classes of steps that it implements. Every kind of fault with
a step of such a class can then strike it: a new kind needs no change in the level. The steps here
are the project's own.
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
"""A `rack.levels.arm.Sensed`: not imported, since that loads MuJoCo."""

APART = np.array([[1e-2], [1e-2]])
"""Error of a stuck sensor, rad and rad/s, from which it counts as wrong: while a joint creeps,
nobody need notice it earlier."""


class Fault(NamedTuple):
    """A fault injected into the arm, or another device that a level drives."""

    kind: str  # as in "sensor-nan"
    parameters: Mapping[str, float]  # of the kind, by name
    seed: int  # of its random numbers
    since: int  # tick at which it began
    step: object  # acts the fault; of a class that the level lists in `faults`

    @property
    def joint(self) -> int:
        """The joint that it strikes, by index; -1: all."""
        return int(self.parameters.get("joint", -1))


@dataclass(frozen=True)
class ActiveFault:
    """An injected fault. `place` is its index among those injected; `joints` (joints,) is True
    where it strikes.

    `every` is the level's cycle in ticks; `kept` holds the first sample of each fault, by key.
    """

    place: int
    fault: Fault
    joints: NDArray[np.bool_]
    every: int
    kept: dict[Key, Sample]

    @cached_property
    def key(self) -> Key:
        """Identity of the fault, which stays the same when the set of injected faults changes."""
        return (self.fault.kind, self.fault.seed, self.fault.since, int(self.joints.argmax()))

    def __getitem__(self, parameter: str) -> float:
        """Return a parameter of the fault."""
        return self.fault.parameters[parameter]

    def draw(self, tick: int) -> np.random.Generator:
        """Return the random generator of one tick: a restarted board draws the same numbers."""
        return np.random.default_rng((self.fault.seed, tick))

    def first(self, sample: Sample) -> Sample:
        """Return the sample with which the fault began."""
        if self.key not in self.kept:
            copy = sample._replace(position=sample.position.copy(), velocity=sample.velocity.copy())
            self.kept[self.key] = copy
        return self.kept[self.key]


@dataclass(frozen=True)
class SensorStep:
    """Spoils a sample. `act` returns the spoilt sample, and whether that shows; None: it is the
    truth.

    What shows must be found: the bound counts from there.
    """

    act: Callable[[Sample, ActiveFault], tuple[Sample, bool | None]]


@dataclass(frozen=True)
class MotorStep:
    """Weakens motors. `part` returns the part of its torque limit that a motor still gives, 0 to
    1.
    """

    part: Callable[[ActiveFault], float]


@dataclass(frozen=True)
class CommandStep:
    """Corrupts the torques commanded. `act` takes torques and limits, N m, and returns torques
    (joints,).
    """

    act: Callable[[Array, Array, ActiveFault], Array]


@dataclass(frozen=True)
class TendonStep:
    """Tears a tendon of a hand, so that it gives no tension: that of `joint` on `side`, 0 flexor, 1
    extensor.
    """


ARM_STEPS = (SensorStep, MotorStep, CommandStep)
"""Classes of steps that act on an arm, as `Executor.faults` names them."""


def position_nan(sample: Sample, fault: ActiveFault) -> tuple[Sample, bool]:
    """Make positions NaN."""
    return sample._replace(position=np.where(fault.joints, np.nan, sample.position)), True


def position_biased(sample: Sample, fault: ActiveFault) -> tuple[Sample, bool]:
    """Add `size`, rad, to positions."""
    return sample._replace(position=sample.position + fault["size"] * fault.joints), True


def position_noisy(sample: Sample, fault: ActiveFault) -> tuple[Sample, bool]:
    """Add noise of standard deviation `size`, rad, to positions."""
    noise = fault["size"] * fault.draw(sample.tick).standard_normal(len(fault.joints))
    return sample._replace(position=sample.position + noise * fault.joints), True


def sample_missing(sample: Sample, fault: ActiveFault) -> tuple[Sample, bool]:
    """Repeat the sample of the cycle before the fault."""
    first = fault.first(sample)
    return first._replace(tick=first.tick - fault.every), True


def sample_stuck(sample: Sample, fault: ActiveFault) -> tuple[Sample, bool | None]:
    """Keep positions and velocities as they were when the fault began."""
    first = fault.first(sample)
    truth = (sample.position, sample.velocity)
    stuck = np.where(fault.joints, (first.position, first.velocity), truth)
    off = np.abs(stuck - truth)
    is_apart = bool((off > APART).any()) if off.any() else None
    return sample._replace(position=stuck[0], velocity=stuck[1]), is_apart


def torque_nan(torque: Array, limits: Array, fault: ActiveFault) -> Array:
    """Make torques NaN."""
    return np.full_like(torque, np.nan)


def torque_excessive(torque: Array, limits: Array, fault: ActiveFault) -> Array:
    """Command `factor` times the limit, in the direction of the torque."""
    return fault["factor"] * np.copysign(limits, torque)
