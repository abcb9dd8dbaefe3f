"""How long a random fault lasts and how strong it is: drawn so that it can be seen, by kind."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from random import Random
from typing import NamedTuple

from rack.boards.faults.kinds import KINDS, NUMBERS, Parameter
from rack.tools.campaign.plan import EXTERNAL
from rack.tools.campaign.targets import Target

SIZED = ("sensor-bias", "sensor-noise")
"""Kinds that are seen from a certain size on: the default of their `size` in `rack.boards.faults.kinds`."""
LARGEST = 20.0
"""Sizes are drawn up to that many times the size from which the kind must be seen."""


class Shape(NamedTuple):
    """Length of a fault in ticks, 0 for a kind that strikes once, and its parameters by name."""

    ticks: int
    parameters: Mapping[str, float] = {}


@dataclass(frozen=True)
class Drawing:
    """What shapes draw from: the generator, the place of the fault, the ticks of a second, the arm's joints."""

    rng: Random
    target: Target
    second: float
    joints: int

    def ticks(self, least_s: float, most_s: float) -> int:
        """Return a length of time in ticks."""
        return max(1, round(self.rng.uniform(least_s, most_s) * self.second))

    def cycles(self, least: int, most: int) -> int:
        """Return so many cycles of the task, in ticks."""
        return self.rng.randint(least, most) * self.target.cycle

    def joint(self) -> int:
        """Return a joint; -1, all of them, now and then."""
        return self.rng.randrange(self.joints) if self.rng.random() < 0.9 else -1

    def spread(self, least: float, most: float) -> float:
        """Return a value whose order of magnitude is uniform."""
        return _short(math.exp(self.rng.uniform(math.log(least), math.log(most))))

    def part(self, least: float, most: float) -> float:
        """Return a value between two."""
        return _short(self.rng.uniform(least, most))


def judged_size(kind: str) -> float:
    """Return the size from which a kind of `SIZED` must be seen."""
    return _size(kind).default or 0.0


def _size(kind: str) -> Parameter:
    return next(parameter for parameter in KINDS[NUMBERS[kind]].parameters if parameter.name == "size")


def swept_sizes(kind: str, count: int) -> list[float]:
    """Return sizes for the curve of size against delay, from the smallest that there is."""
    low, high = _size(kind).least, judged_size(kind) * LARGEST
    return [_short(low * (high / low) ** (place / max(1, count - 1))) for place in range(count)]


def shape(drawing: Drawing) -> Shape:
    """Return length and parameters for a fault."""
    return _SHAPES[drawing.target.kind](drawing)


def _mute(d: Drawing) -> Shape:
    # More than it takes the fastest reader to see it.
    return Shape(round((2 * d.target.cycle + d.target.reader) * d.rng.uniform(1.2, 2.0)))


def _messages(d: Drawing, more: int = 0) -> int:
    """Return a length in which several messages are written, and one more is read."""
    return max(d.cycles(4 + more, 8 + more), 2 * d.target.reader)


def _sized(d: Drawing) -> Shape:
    least = judged_size(d.target.kind)
    return Shape(d.ticks(0.1, 0.5), {"joint": d.joint(), "size": d.spread(least, LARGEST * least)})


_SHAPES: Mapping[str, Callable[[Drawing], Shape]] = {
    "kill": lambda d: Shape(0),
    EXTERNAL: lambda d: Shape(0),
    "hang": lambda d: Shape(d.cycles(7, 10)),
    "overrun": lambda d: Shape(d.cycles(1, 4), {"by": d.part(1.2, 2.5)}),
    "planner-slow": lambda d: Shape(max(d.cycles(3, 6), d.ticks(1.0, 2.0)), {"by": d.part(1.5, 4.0)}),
    "hog": lambda d: Shape(max(d.cycles(7, 9), d.ticks(0.1, 0.3))),
    "mute": _mute,
    "drop": lambda d: Shape(_messages(d), {"probability": d.part(0.5, 0.9)}),
    "delay": lambda d: Shape(_messages(d, more=5), {"by": d.rng.randint(1, 5)}),
    "reorder": lambda d: Shape(_messages(d), {"probability": d.part(0.5, 0.9)}),
    "corrupt": lambda d: Shape(_messages(d), {"probability": d.part(0.5, 1.0), "bits": d.rng.randint(1, 16)}),
    "babble": lambda d: Shape(d.cycles(3, 6), {"writes": d.rng.randint(8, 64)}),
    "masquerade": lambda d: Shape(0),
    "lock-held": lambda d: Shape(0, {"killed": d.rng.randint(0, 1)}),
    "clock-stop": lambda d: Shape(d.ticks(0.05, 0.3)),
    "clock-skip": lambda d: Shape(0, {"ticks": d.rng.randint(1, 20)}),
    "clock-jitter": lambda d: Shape(d.ticks(0.2, 0.6), {"late": d.part(0.75, 0.95)}),
    "sensor-nan": lambda d: Shape(d.ticks(0.02, 0.3), {"joint": d.joint()}),
    # A joint that stands does not show that its sensor is stuck: some are stuck all together, for long enough.
    "sensor-stuck": lambda d: Shape(d.ticks(0.5, 1.5), {"joint": d.rng.choice((-1, d.rng.randrange(d.joints)))}),
    "sensor-dropout": lambda d: Shape(d.ticks(0.02, 0.3)),
    "sensor-bias": _sized,
    "sensor-noise": _sized,
    "actuator-off": lambda d: Shape(d.ticks(0.05, 0.4), {"joint": d.joint()}),
    "actuator-saturated": lambda d: Shape(d.ticks(0.05, 0.4), {"joint": d.joint(), "part": d.part(0.0, 0.05)}),
    "command-nan": lambda d: Shape(d.ticks(0.01, 0.2), {"joint": d.joint()}),
    "command-limit": lambda d: Shape(d.ticks(0.01, 0.2), {"joint": d.joint(), "factor": d.spread(3.0, 1000.0)}),
    "self-test": lambda d: Shape(0),
}


def _short(value: float) -> float:
    """Return a value with the digits that a file shows, so that a plan read back is the same plan."""
    return float(f"{value:.4g}")
