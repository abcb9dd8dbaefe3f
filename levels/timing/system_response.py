"""The response of the whole system, predicted: its bounds (eqs 3.2, 3.3), and the path of an operator's command."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.queue import is_position
from rack.levels.timing.equations import response_ticks, system_response_bound_ns, system_response_ns
from rack.levels.timing.rack import RackTiming


@dataclass(frozen=True)
class Prediction:
    """Response of the hierarchy, in ms of simulated time; all 0 without one. `levels` are its boards by level, as text.

    `command_ms` and `status_ms` are the bounds down and up, with the waits for the grid. `plan_ms` is, by level, the
    time from a planner's release until its plan can be used.
    """

    levels: tuple[str, ...]
    bound_eq_3_2_ms: float
    sum_eq_3_3_ms: float
    command_ms: float
    status_ms: float
    plan_ms: dict[str, float]


def predict(rack: RackTiming) -> Prediction:
    """Return the system's response as it follows from the cycles alone."""
    hierarchy, tick_ms = rack.hierarchy, rack.clock_ns * 1e-6
    cycles = hierarchy.cycles
    planned = [board for board in rack.boards.values() if board.has_planner]
    return Prediction(
        levels=hierarchy.levels,
        bound_eq_3_2_ms=system_response_bound_ns(cycles or [0]) * tick_ms,
        sum_eq_3_3_ms=system_response_ns((), cycles) * tick_ms,
        command_ms=response_ticks(cycles) * tick_ms,
        status_ms=response_ticks(cycles[::-1]) * tick_ms,
        plan_ms={board.name: board.every * board.within_cycles * tick_ms for board in planned},
    )


@dataclass(frozen=True)
class CommandPath:
    """The levels that an operator's command passes, from the commanded one to the lowest; `cycles` in ticks.

    `delay` is the ticks until a given command can be read. `is_exact` is true if every message on the path is of
    protocol time-slice: with all deadlines met, the releases below are then exact, otherwise bounds.
    """

    levels: tuple[str, ...]
    cycles: tuple[int, ...]
    delay: int
    is_exact: bool

    def samples_at(self, visible_at: int) -> int:
        """Return the release of the first level that reads a command visible from that tick on."""
        return _up(visible_at, self.cycles[0])

    def acts_at(self, visible_at: int) -> int:
        """Return the release of the lowest level's cycle that rests on the command."""
        release = self.samples_at(visible_at)
        for earlier, later in zip(self.cycles, self.cycles[1:], strict=False):
            # Output is visible at the end of its cycle; the next level reads it at its next release (eq. 3.7).
            release = _up(release + earlier, later)
        return release

    def response(self, given: int, acts: int) -> int:
        """Return the ticks from giving the command to the end of the cycle that acts on it."""
        return acts + self.cycles[-1] - given

    @property
    def bound_eq_3_2(self) -> int:
        """Number of levels times the longest cycle (eq. 3.2), from the release that reads the command."""
        return len(self.cycles) * max(self.cycles)

    @property
    def sum_eq_3_3(self) -> int:
        """The sum of the cycles (eq. 3.3), from the release that reads the command, if each divides the one above."""
        return sum(self.cycles)

    @property
    def longest(self) -> int:
        """The longest response on the grid: given just too late for a release, waiting for every level's next one."""
        return self.delay + self.cycles[0] - 1 + response_ticks(self.cycles)


def mailboxes_along(layout: Layout, boards: Sequence[str]) -> tuple[MailboxSpec, ...]:
    """Return the mailboxes that take information from board to board, each resting on the one before.

    Where the way is broken, they are those of its end: of the longest part that arrives at the last board. A queue
    breaks it: how long its messages wait there is for their writer to decide.
    """
    if len(boards) < 2:
        return ()
    sampled = [box for box in layout.mailboxes if box.protocol != "queue" and not is_position(box)]
    return _along(layout, boards[:-1], {box.name for box in sampled if boards[-1] in box.readers})


def _along(layout: Layout, boards: Sequence[str], taken: Collection[str]) -> tuple[MailboxSpec, ...]:
    """Return the longest row of mailboxes, one a board, that ends with one of those `taken`."""
    if not boards:
        return ()
    last = [box for box in layout.mailboxes if box.writer == boards[-1] and box.name in taken]
    return max(((*_along(layout, boards[:-1], box.rests_on), box) for box in last), key=len, default=())


def command_paths(rack: RackTiming, layout: Layout) -> dict[str, CommandPath]:
    """Return the longest path from every level that an operator can command to the lowest, by level."""
    boxes = {box.name: box for box in layout.mailboxes}
    found: dict[str, CommandPath] = {}
    for chain in rack.chains:
        passed = mailboxes_along(layout, chain)
        for at, level in enumerate(chain):
            operator, rest = boxes.get(f"{level}.operator"), chain[at:]
            if operator is None or len(passed) < len(rest) - 1:
                continue
            cycles = tuple(rack.boards[name].every for name in rest)
            taken = (operator, *passed[len(passed) - len(rest) + 1 :])
            is_exact = all(box.protocol == "time-slice" for box in taken)
            path = CommandPath(rest, cycles, operator.delay, is_exact)
            if level not in found or path.longest > found[level].longest:
                found[level] = path
    return found


def _up(tick: int, every: int) -> int:
    return -(-tick // every) * every
