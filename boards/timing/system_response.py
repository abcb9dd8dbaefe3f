"""The response of the whole system, predicted: its bounds (eqs 3.2, 3.3), and the mailboxes along
which information passes.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.queue import is_position
from rack.boards.timing.rack import RackTiming


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
    planned = [board for board in rack.boards.values() if board.has_planner]
    return Prediction(
        levels=hierarchy.levels,
        bound_eq_3_2_ms=hierarchy.bound * tick_ms,
        sum_eq_3_3_ms=sum(hierarchy.cycles) * tick_ms,
        command_ms=rack.command_ticks(hierarchy) * tick_ms,
        status_ms=rack.status_ticks(hierarchy) * tick_ms,
        plan_ms={board.name: board.every * board.within_cycles * tick_ms for board in planned},
    )


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
