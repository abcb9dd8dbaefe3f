"""Random faults: duration and strength, drawn so that the fault is detectable.

A kind's record holds draws made by the functions here; a campaign calls them. The same generator
draws the same fault.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

BEYOND = 20.0
"""Sizes are drawn up to this multiple of the smallest size that must be detected."""


@dataclass(frozen=True)
class Drawing:
    """The basis of a draw: the generator, ticks per simulated second, and the number of joints.

    `cycle` is that of the affected task, `reader` that of its mailbox's fastest reader, ticks.
    """

    rng: Random
    cycle: int
    reader: int
    second: float
    joints: int


Draw = Callable[[Drawing], float]
DrawTicks = Callable[[Drawing], int]


def number(least: float, most: float) -> Draw:
    """Draw a number, uniformly."""
    return lambda d: _short(d.rng.uniform(least, most))


def whole(least: int, most: int) -> Draw:
    """Draw a whole number, uniformly."""
    return lambda d: d.rng.randint(least, most)


def magnitude(least: float, most: float) -> Draw:
    """Draw a number, log-uniformly."""
    return lambda d: _short(math.exp(d.rng.uniform(math.log(least), math.log(most))))


def joint(d: Drawing) -> int:
    """Draw a joint; in one case of ten -1, all joints."""
    return d.rng.randrange(d.joints) if d.rng.random() < 0.9 else -1


def joint_or_all(d: Drawing) -> int:
    """Draw a joint or, in half of all cases, -1: all joints."""
    return d.rng.choice((-1, d.rng.randrange(d.joints)))


def seconds(least: float, most: float) -> DrawTicks:
    """Draw a duration in simulated seconds, ticks."""
    return lambda d: max(1, round(d.rng.uniform(least, most) * d.second))


def cycles(least: int, most: int) -> DrawTicks:
    """Draw a duration in cycles of the task, ticks."""
    return lambda d: d.rng.randint(least, most) * d.cycle


def messages(least: int, most: int) -> DrawTicks:
    """Draw a duration in messages, ticks; at least two reads of the fastest reader."""
    return lambda d: max(d.rng.randint(least, most) * d.cycle, 2 * d.reader)


def longest(*lengths: DrawTicks) -> DrawTicks:
    """Draw several durations and take the longest."""
    return lambda d: max(draw(d) for draw in lengths)


def silence(least: float, most: float) -> DrawTicks:
    """Draw a multiple of the time within which the fastest reader must notice a silent mailbox."""
    return lambda d: round((2 * d.cycle + d.reader) * d.rng.uniform(least, most))


def swept(least: float, visible: float, count: int) -> list[float]:
    """Return `count` sizes for a curve of size against delay: a geometric series from `least`."""
    ratio = BEYOND * visible / least
    return [_short(least * ratio ** (place / max(1, count - 1))) for place in range(count)]


def _short(value: float) -> float:
    """Return a value rounded as files show it, so that a plan read back is the same plan."""
    return float(f"{value:.4g}")
