"""Commands at random ticks: holds and resumes, each given when the one before it has gone all the way down."""

from __future__ import annotations

from collections.abc import Mapping
from random import Random

from rack.boards.operating.command import CommandConfig
from rack.tools.responding.course import Course

RUN_S = 24.0
"""Simulated time of one run, at most."""
LEAD_S = 2.0
"""Simulated time before the first command: the arm of a task is about to move by then."""
BREATH_S = 1.2
"""Simulated time between the response to a command and the next one, at most: the arm is to be under way again."""


def draw(courses: Mapping[str, Course], clock_ns: int, random: Random, most: int) -> list[CommandConfig]:
    """Return at most `most` commands for one run, an even number: the levels in turn, shuffled every time.

    Breaths are longer than the longest cycle, or many of them: so every phase is as likely as any other.
    """
    drawn: list[CommandConfig] = []
    tick, end = round(LEAD_S * 1e9 / clock_ns), round(RUN_S * 1e9 / clock_ns)
    breath = round(BREATH_S * 1e9 / clock_ns)
    while True:
        for level in random.sample(list(courses), len(courses)):
            at, longest = tick + random.randint(1, breath), courses[level].longest
            again = at + longest + random.randint(1, breath)
            if again + longest >= end or len(drawn) + 2 > most:
                return drawn
            drawn += [CommandConfig(level=level, what="hold", tick=at)]
            drawn += [CommandConfig(level=level, what="resume", tick=again)]
            tick = again + longest
