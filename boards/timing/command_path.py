"""The path of an operator's command, from the commanded level to the lowest, and its longest
response.
"""

from __future__ import annotations

from dataclasses import dataclass

from rack.backplane.layout import Layout, TickGrid
from rack.boards.timing.rack import RackTiming, grid_wait
from rack.boards.timing.system_response import mailboxes_along


@dataclass(frozen=True)
class CommandPath:
    """The levels that an operator's command passes, from the commanded one to the lowest.

    `releases` are the ticks at which each level begins its cycles, `reads` those at which it reads
    the command of the one above it, the first the operator's. `delay` is the ticks until a given
    command can be read. `is_exact` is true if every message on the path is of protocol time-slice:
    with all deadlines met, the releases below are then exact, otherwise bounds.
    """

    levels: tuple[str, ...]
    releases: tuple[TickGrid, ...]
    reads: tuple[TickGrid, ...]
    delay: int
    is_exact: bool

    @property
    def cycles(self) -> tuple[int, ...]:
        """The cycle of each level, ticks."""
        return tuple(releases.every for releases in self.releases)

    def samples_at(self, visible_at: int) -> int:
        """Return the release of the first level that reads a command visible from that tick on."""
        return self.reads[0].since(visible_at)

    def acts_at(self, visible_at: int) -> int:
        """Return the release of the lowest level's cycle that rests on the command."""
        release = self.samples_at(visible_at)
        for cycle, read in zip(self.cycles, self.reads[1:], strict=False):
            # Output is visible at the end of its cycle; the next level reads it at its next release
            # (eq. 3.7).
            release = read.since(release + cycle)
        return release

    def response(self, given: int, acts: int) -> int:
        """Return the ticks from giving the command to the end of the cycle that acts on it."""
        return acts + self.cycles[-1] - given

    @property
    def bound_eq_3_2(self) -> int:
        """Number of levels times the longest cycle (eq. 3.2), from the release that reads the
        command.
        """
        return len(self.cycles) * max(self.cycles)

    @property
    def sum_eq_3_3(self) -> int:
        """The sum of the cycles (eq. 3.3), from the release that reads the command, if each divides
        the one above.
        """
        return sum(self.cycles)

    @property
    def longest(self) -> int:
        """The longest response on the grid: given just too late for a release, waiting for every
        level's next one.
        """
        waits = [
            grid_wait(written, read)
            for written, read in zip(self.releases, self.reads[1:], strict=False)
        ]
        return self.delay + self.reads[0].every - 1 + sum(self.cycles) + sum(waits)


def command_paths(rack: RackTiming, layout: Layout) -> dict[str, CommandPath]:
    """Return the longest path from every level that an operator can command to the lowest, by
    level.
    """
    boxes = {box.name: box for box in layout.mailboxes}
    found: dict[str, CommandPath] = {}
    for chain in rack.chains:
        passed = mailboxes_along(layout, chain)
        for at, level in enumerate(chain):
            operator = boxes.get(f"{level}.operator")
            rest = chain[at:]
            if operator is None or len(passed) < len(rest) - 1:
                continue
            taken = (operator, *passed[len(passed) - len(rest) + 1 :])
            releases = tuple(rack.boards[name].releases for name in rest)
            reads = tuple(
                layout.read_grid(box, name) for box, name in zip(taken, rest, strict=True)
            )
            is_exact = all(box.protocol == "time-slice" and box.is_repeatable for box in taken)
            path = CommandPath(rest, releases, reads, operator.delay, is_exact)
            if level not in found or path.longest > found[level].longest:
                found[level] = path
    return found
