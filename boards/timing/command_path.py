"""Path of an operator's command down to the lowest level, and its longest response."""

from __future__ import annotations

from dataclasses import dataclass

from rack.backplane.layout import Layout, TickGrid
from rack.boards.timing.rack import RackTiming, compute_grid_wait
from rack.boards.timing.system_response import find_path_mailboxes


@dataclass(frozen=True)
class CommandPath:
    """Levels that an operator's command passes.

    Attributes:
        levels: Levels from the commanded one to the lowest.
        releases: Ticks at which each level begins its cycles.
        reads: Ticks at which each level reads the command from the level above it, the first level
            from the operator.
        delay: Ticks from issuing a command until it can be read.
        is_exact: Whether all messages on the path have protocol time-slice. Then the computed
            releases are exact if all deadlines are met, and otherwise they are bounds.
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
        """Return the first release at which the first level can read a command.

        Args:
            visible_at: Tick at which the command becomes visible to that level.
        """
        return self.reads[0].find_tick(visible_at)

    def find_acting_release(self, visible_at: int) -> int:
        """Return the release at which the lowest level acts on a command.

        Args:
            visible_at: Tick at which the command becomes visible to the first level.
        """
        release = self.find_reading_release(visible_at)
        for cycle, read in zip(self.cycles, self.reads[1:], strict=False):
            # Output becomes visible at the end of the cycle, and the next level reads it at its
            # next release (eq. 3.7).
            release = read.find_tick(release + cycle)
        return release

    def compute_response(self, given: int, acts: int) -> int:
        """Return the time in ticks from a command to the end of the cycle that acts on it.

        Args:
            given: Tick at which the command is issued.
            acts: Release of the lowest level's cycle that acts on it.
        """
        return acts + self.cycles[-1] - given

    @property
    def bound_eq_3_2(self) -> int:
        """Bound of eq. 3.2 in ticks: the number of levels times the longest cycle.

        The response is measured from the release that reads the command.
        """
        return len(self.cycles) * max(self.cycles)

    @property
    def sum_eq_3_3(self) -> int:
        """Bound of eq. 3.3 in ticks: the sum of the cycles.

        It is valid if each cycle divides the cycle of the level above. The response is measured
        from the release that reads the command.
        """
        return sum(self.cycles)

    @property
    def longest(self) -> int:
        """Longest response in ticks: the command just misses a release and waits at every level."""
        waits = [
            compute_grid_wait(written, read)
            for written, read in zip(self.releases, self.reads[1:], strict=False)
        ]
        return self.delay + self.reads[0].every - 1 + sum(self.cycles) + sum(waits)


def find_command_paths(rack: RackTiming, layout: Layout) -> dict[str, CommandPath]:
    """Return the longest path to the lowest level for each level that an operator can command."""
    boxes = {box.name: box for box in layout.mailboxes}
    paths: dict[str, CommandPath] = {}
    for chain in rack.chains:
        chain_boxes = find_path_mailboxes(layout, chain)
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
