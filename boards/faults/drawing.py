"""Distributions of the duration and the strength of random faults that can be detected.

A draw is a function that draws a random value. The records of the kinds contain draws, and
campaigns call them. Generators in equal states draw equal faults.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

MAX_SIZE_RATIO = 20.0
"""Ratio of the largest size drawn to the smallest size that must be detected."""


@dataclass(frozen=True)
class Drawing:
    """Random generator and facts about the rack from which a draw computes a value.

    Attributes:
        rng: Random generator.
        cycle: Cycle of the affected task in ticks.
        reader: Cycle of the fastest reader of the affected mailbox in ticks.
        second: Number of ticks in a simulated second.
        joints: Number of joints.
    """

    rng: Random
    cycle: int
    reader: int
    second: float
    joints: int


Draw = Callable[[Drawing], float]
DrawTicks = Callable[[Drawing], int]


def uniform_number(least: float, most: float) -> Draw:
    """Return a draw from a uniform distribution between two numbers."""
    return lambda d: _round_as_saved(d.rng.uniform(least, most))


def uniform_integer(least: int, most: int) -> Draw:
    """Return a draw from a uniform distribution over the integers from `least` to `most`."""
    return lambda d: d.rng.randint(least, most)


def log_uniform_number(least: float, most: float) -> Draw:
    """Return a draw from a log-uniform distribution between two numbers."""
    return lambda d: _round_as_saved(math.exp(d.rng.uniform(math.log(least), math.log(most))))


def draw_joint(d: Drawing) -> int:
    """Draw the index of a joint, or -1 (all joints) with probability 0.1."""
    return d.rng.randrange(d.joints) if d.rng.random() < 0.9 else -1


def draw_joint_or_all(d: Drawing) -> int:
    """Draw the index of a joint, or -1 (all joints) with probability 0.5."""
    return d.rng.choice((-1, d.rng.randrange(d.joints)))


def uniform_seconds(least: float, most: float) -> DrawTicks:
    """Return a draw of a duration in ticks, uniform between two simulated times in s."""
    return lambda d: max(1, round(d.rng.uniform(least, most) * d.second))


def uniform_cycles(least: int, most: int) -> DrawTicks:
    """Return a draw of a duration in ticks, uniform between `least` and `most` task cycles."""
    return lambda d: d.rng.randint(least, most) * d.cycle


def uniform_messages(least: int, most: int) -> DrawTicks:
    """Return a draw of a duration in ticks in which the task writes `least` to `most` messages.

    The duration is at least two cycles of the fastest reader, so that the reader can notice it.
    """
    return lambda d: max(d.rng.randint(least, most) * d.cycle, 2 * d.reader)


def longest_of(*lengths: DrawTicks) -> DrawTicks:
    """Return a draw of a duration that is the longest of several draws."""
    return lambda d: max(draw(d) for draw in lengths)


def uniform_silence(least: float, most: float) -> DrawTicks:
    """Return a draw of the time in ticks for which a task writes no messages.

    `least` and `most` are multiples of the time within which the fastest reader must notice that
    messages are missing.
    """
    return lambda d: round((2 * d.cycle + d.reader) * d.rng.uniform(least, most))


def list_sweep_sizes(least: float, visible: float, count: int) -> list[float]:
    """Return a geometric series of fault sizes for measuring the detection delay.

    Args:
        least: Smallest size.
        visible: Smallest size that must be detected. The series ends at `MAX_SIZE_RATIO` times this
            size.
        count: Number of sizes.
    """
    ratio = MAX_SIZE_RATIO * visible / least
    return [_round_as_saved(least * ratio ** (index / max(1, count - 1))) for index in range(count)]


def _round_as_saved(value: float) -> float:
    """Round a value to 4 significant digits, so that it is equal when read back from a file."""
    return float(f"{value:.4g}")
