"""The course of an operator's command down the levels, worked out on the clock's grid before anything runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rack.backplane.layout import Layout
from rack.boards.config.schema import RackConfig
from rack.tools.timing.prediction import hierarchy, response_ticks


@dataclass(frozen=True)
class Course:
    """The levels that a command passes, from the one that it is given to down to the lowest; `cycles` in ticks.

    `delay` is the ticks from its giving until it can be read, `is_exact` whether every message on the way is of
    protocol time-slice: then, deadlines kept, the ticks below are not bounds but what will be.
    """

    levels: tuple[str, ...]
    cycles: tuple[int, ...]
    delay: int
    is_exact: bool

    def samples_at(self, visible_at: int) -> int:
        """Return the release of the first level that reads a command visible from that tick on."""
        return _up(visible_at, self.cycles[0])

    def acts_at(self, visible_at: int) -> int:
        """Return the release of the lowest level whose cycle rests on it."""
        release = self.samples_at(visible_at)
        for earlier, later in zip(self.cycles, self.cycles[1:], strict=False):
            # What a level writes is visible when its cycle is over, and read at the next one's next release (eq. 3.7).
            release = _up(release + earlier, later)
        return release

    def response(self, given: int, acts: int) -> int:
        """Return the ticks from its giving to the end of the cycle that acts on it."""
        return acts + self.cycles[-1] - given

    @property
    def bound_eq_3_2(self) -> int:
        """As many longest cycles as there are levels (eq. 3.2), from the release that reads it."""
        return len(self.cycles) * max(self.cycles)

    @property
    def sum_eq_3_3(self) -> int:
        """The sum of the cycles (eq. 3.3): from the release that reads it, where every cycle divides the one above."""
        return sum(self.cycles)

    @property
    def longest(self) -> int:
        """The longest on the grid: given just too late for a release, and waiting for every level's next one."""
        return self.delay + self.cycles[0] - 1 + response_ticks(list(self.cycles))


def courses(config: RackConfig, layout: Layout) -> dict[str, Course]:
    """Return the course from every level of the hierarchy that an operator can command."""
    levels, boxes = hierarchy(config), {box.name: box for box in layout.mailboxes}
    found = {}
    for at, level in enumerate(levels):
        passed = levels[at:]
        names = [f"{level}.operator", *(f"{name}.command" for name in passed[:-1])]
        if all(name in boxes for name in names):
            cycles = tuple(layout.task(name).every for name in passed)
            is_exact = all(boxes[name].protocol == "time-slice" for name in names)
            found[level] = Course(passed, cycles, boxes[names[0]].delay, is_exact)
    return found


def acting(found: Sequence[Course]) -> str:
    """Return the lowest level, which acts on every command."""
    return found[0].levels[-1]


def _up(tick: int, every: int) -> int:
    return -(-tick // every) * every
