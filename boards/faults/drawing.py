"""Random faults: how long one lasts and how strong it is, drawn so that it can be seen.

A kind's record names what to draw, by the functions here; a campaign draws. The same generator draws the same fault.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

BEYOND = 20.0
"""Sizes are drawn up to so many times the size from which a kind must be found."""


@dataclass(frozen=True)
class Drawing:
    """The basis of a draw: the generator, ticks of a simulated second, and the number of the arm's joints.

    `cycle` is that of the task struck and `reader` that of its mailbox's fastest reader, in ticks.
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
    """Draw a number whose order of magnitude is uniform."""
    return lambda d: _short(math.exp(d.rng.uniform(math.log(least), math.log(most))))


def size_from(visible: float) -> Draw:
    """Draw a size from the one at which the kind must be found."""
    return magnitude(visible, BEYOND * visible)


def joint(d: Drawing) -> int:
    """Draw a joint; -1, all of them, now and then."""
    return d.rng.randrange(d.joints) if d.rng.random() < 0.9 else -1


def joint_or_all(d: Drawing) -> int:
    """Draw a joint, or -1, all of them, as often as not."""
    return d.rng.choice((-1, d.rng.randrange(d.joints)))


def seconds(least: float, most: float) -> DrawTicks:
    """Draw a length of simulated time, in ticks."""
    return lambda d: max(1, round(d.rng.uniform(least, most) * d.second))


def cycles(least: int, most: int) -> DrawTicks:
    """Draw a length in cycles of the task, in ticks."""
    return lambda d: d.rng.randint(least, most) * d.cycle


def messages(least: int, most: int) -> DrawTicks:
    """Draw a length in which so many messages are written, and two reads of the fastest reader."""
    return lambda d: max(d.rng.randint(least, most) * d.cycle, 2 * d.reader)


def longest(*lengths: DrawTicks) -> DrawTicks:
    """Draw several lengths and take the longest."""
    return lambda d: max(draw(d) for draw in lengths)


def silence(least: float, most: float) -> DrawTicks:
    """Draw a multiple of the time in which the fastest reader must notice that a mailbox is silent."""
    return lambda d: round((2 * d.cycle + d.reader) * d.rng.uniform(least, most))


def swept(least: float, visible: float, count: int) -> list[float]:
    """Return `count` sizes for a curve of size against delay, in equal ratios, from the least possible one."""
    ratio = BEYOND * visible / least
    return [_short(least * ratio ** (place / max(1, count - 1))) for place in range(count)]


def _short(value: float) -> float:
    """Return a value with the digits that a file shows, so that a plan read back is the same plan."""
    return float(f"{value:.4g}")
