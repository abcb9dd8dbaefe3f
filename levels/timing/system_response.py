"""The response of the whole system, predicted: its bounds (eqs 3.2, 3.3), and the path of an
operator's command."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from rack.backplane.layout import Layout, MailboxSpec, TickGrid
from rack.backplane.mailbox.queue import is_position
from rack.levels.timing.equations import (
    grid_wait,
    response_ticks,
    system_response_bound_ns,
    system_response_ns,
)
from rack.levels.timing.rack import RackTiming


@dataclass(frozen=True)
class Prediction:
    """Response of the hierarchy, in ms of simulated time; all 0 without one. `levels` are its
    boards by level, as text.

    `command_ms` and `status_ms` are the bounds down and up, with the waits for the grid. `plan_ms`
    is, by level, the time from a planner's release until its plan can be used.
    """

    levels: tuple[str, ...]
    bound_eq_3_2_ms: float
    sum_eq_3_3_ms: float
    command_ms: float
    status_ms: float
    plan_ms: dict[str, float]


def predict(rack: RackTiming) -> Prediction:
    """Return the system's response as it follows from the cycles alone."""
    hierarchy = rack.hierarchy
    tick_ms = rack.clock_ns * 1e-6
    cycles = hierarchy.cycles
    planned = [board for board in rack.boards.values() if board.has_planner]
    return Prediction(
        levels=hierarchy.levels,
        bound_eq_3_2_ms=system_response_bound_ns(cycles or [0]) * tick_ms,
        sum_eq_3_3_ms=system_response_ns((), cycles) * tick_ms,
        command_ms=rack.command_ticks(hierarchy) * tick_ms,
        status_ms=rack.status_ticks(hierarchy) * tick_ms,
        plan_ms={board.name: board.every * board.within_cycles * tick_ms for board in planned},
    )


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
        command."""
        return len(self.cycles) * max(self.cycles)

    @property
    def sum_eq_3_3(self) -> int:
        """The sum of the cycles (eq. 3.3), from the release that reads the command, if each divides
        the one above."""
        return sum(self.cycles)

    @property
    def longest(self) -> int:
        """The longest response on the grid: given just too late for a release, waiting for every
        level's next one."""
        waits = [
            grid_wait(written, read)
            for written, read in zip(self.releases, self.reads[1:], strict=False)
        ]
        return self.delay + self.reads[0].every - 1 + response_ticks(self.cycles, waits)


def mailboxes_along(layout: Layout, boards: Sequence[str]) -> tuple[MailboxSpec, ...]:
    """Return the mailboxes that take information from board to board, each resting on the one
    before.

    Where the way is broken, they are those of its end: of the longest part that arrives at the last
    board. A queue breaks it: how long its messages wait there is for their writer to decide.
    """
    if len(boards) < 2:
        return ()
    sampled = [box for box in layout.mailboxes if box.protocol != "queue" and not is_position(box)]
    return _along(layout, boards[:-1], {box.name for box in sampled if boards[-1] in box.readers})


def _along(
    layout: Layout, boards: Sequence[str], taken: Collection[str]
) -> tuple[MailboxSpec, ...]:
    """Return the longest row of mailboxes, one a board, that ends with one of those `taken`."""
    if not boards:
        return ()
    last = [box for box in layout.mailboxes if box.writer == boards[-1] and box.name in taken]
    return max(
        ((*_along(layout, boards[:-1], box.rests_on), box) for box in last), key=len, default=()
    )


def command_paths(rack: RackTiming, layout: Layout) -> dict[str, CommandPath]:
    """Return the longest path from every level that an operator can command to the lowest, by
    level."""
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
