"""Path of an operator's command down to the lowest level, and its longest response."""

from __future__ import annotations

from dataclasses import dataclass

from rack.backplane.layout import Layout, TickGrid
from rack.boards.timing.rack import RackTiming, compute_grid_wait
from rack.boards.timing.system_response import find_path_mailboxes


@dataclass(frozen=True)
class CommandPath:
    """Path of an operator's command through the levels.

    Attributes:
        levels: Levels from the commanded one to the lowest.
        releases: Ticks at which each level begins its cycles.
        reads: Ticks at which each level reads the command: the first level from the operator, the
            others from the level above.
        delay: Ticks from issuing a command until the first level can read it.
        is_exact: Whether all mailboxes on the path have protocol time-slice. If so, and if all
            deadlines are met, computed releases are exact. Otherwise they are bounds.
    """

    levels: tuple[str, ...]
    releases: tuple[TickGrid, ...]
    reads: tuple[TickGrid, ...]
    delay: int
    is_exact: bool

    @property
    def cycles(self) -> tuple[int, ...]:
        """Cycle of each level in ticks."""
        return tuple(releases.every for releases in self.releases)

    def find_reading_release(self, visible_at: int) -> int:
        """Return the release at which the first level reads a command.

        Args:
            visible_at: Tick at which the command becomes visible to that level.
        """
        return self.reads[0].find_tick(visible_at)

    def find_acting_release(self, visible_at: int) -> int:
        """Return the release of the cycle in which the lowest level acts on a command.

        Args:
            visible_at: Tick at which the command becomes visible to the first level.
        """
        release = self.find_reading_release(visible_at)
        for cycle, read in zip(self.cycles, self.reads[1:], strict=False):
            # Output becomes visible at the end of the cycle, and the next level reads it at its
            # next release (eq. 3.7).
            release = read.find_tick(release + cycle)
        return release

    @property
    def bound_eq_3_2(self) -> int:
        """Bound of eq. 3.2 in ticks: the number of levels times the longest cycle.

        It limits the response from the release at which the first level reads the command.
        """
        return len(self.cycles) * max(self.cycles)

    @property
    def sum_eq_3_3(self) -> int:
        """Bound of eq. 3.3 in ticks: the sum of the cycles.

        It is valid if each cycle divides the cycle of the level above. It limits the response from
        the release at which the first level reads the command.
        """
        return sum(self.cycles)

    @property
    def longest(self) -> int:
        """Longest response in ticks.

        The command just misses a release, and each message waits as long as possible.
        """
        waits = [
            compute_grid_wait(written, read)
            for written, read in zip(self.releases, self.reads[1:], strict=False)
        ]
        return self.delay + self.reads[0].every - 1 + sum(self.cycles) + sum(waits)


def find_command_paths(rack: RackTiming, layout: Layout) -> dict[str, CommandPath]:
    """Return, for each level that an operator can command, its longest path to a lowest level."""
    boxes = {box.name: box for box in layout.mailboxes}
    paths: dict[str, CommandPath] = {}
    rows = ((chain, row) for chain in rack.chains for row in find_path_mailboxes(layout, chain))
    for chain, chain_boxes in rows:
        for at, level in enumerate(chain):
            operator = boxes.get(f"{level}.operator")
            levels = chain[at:]
            if operator is None or len(chain_boxes) < len(levels) - 1:
                continue
            path_boxes = (operator, *chain_boxes[len(chain_boxes) - len(levels) + 1 :])
            releases = tuple(rack.boards[name].releases for name in levels)
            reads = tuple(
                layout.find_read_grid(box, name)
                for box, name in zip(path_boxes, levels, strict=True)
            )
            is_exact = all(box.protocol == "time-slice" and box.is_repeatable for box in path_boxes)
            path = CommandPath(levels, releases, reads, operator.delay, is_exact)
            if level not in paths or path.longest > paths[level].longest:
                paths[level] = path
    return paths
