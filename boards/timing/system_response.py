"""Predicted system response: its bounds (eqs 3.2, 3.3) and the mailboxes on its path."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.queue import is_position_mailbox
from rack.boards.timing.rack import RackTiming

MailboxRow = tuple[MailboxSpec, ...]
"""Mailboxes that information passes one after the other."""


@dataclass(frozen=True)
class Prediction:
    """Predicted response of the hierarchy in simulated time. 0 if the rack has no hierarchy.

    Attributes:
        levels: Boards of each level, as text.
        bound_eq_3_2_ms: Bound of eq. 3.2.
        sum_eq_3_3_ms: Sum of eq. 3.3.
        command_ms: Longest response of a command, down to the lowest level, including waits for
            releases.
        status_ms: Longest response of a status, up to the highest level, including these waits.
        plan_ms: Time from a planner's release until its plan can be used, keyed by board.
    """

    levels: tuple[str, ...]
    bound_eq_3_2_ms: float
    sum_eq_3_3_ms: float
    command_ms: float
    status_ms: float
    plan_ms: dict[str, float]


def predict_response(rack: RackTiming) -> Prediction:
    """Predict the system response from the cycles of the boards."""
    hierarchy = rack.hierarchy
    tick_ms = rack.clock_ns * 1e-6
    planned = [board for board in rack.boards.values() if board.has_planner]
    return Prediction(
        levels=hierarchy.levels,
        bound_eq_3_2_ms=hierarchy.bound * tick_ms,
        sum_eq_3_3_ms=sum(hierarchy.cycles) * tick_ms,
        command_ms=rack.compute_longest_ticks(hierarchy) * tick_ms,
        status_ms=rack.compute_longest_ticks(hierarchy, -1) * tick_ms,
        plan_ms={board.name: board.every * board.within_cycles * tick_ms for board in planned},
    )


def find_path_mailboxes(layout: Layout, boards: Sequence[str]) -> list[MailboxRow]:
    """Return the rows of mailboxes that carry information along a sequence of boards.

    Each level reads one mailbox of a row and writes the next one. If no row begins
    at the first board, the longest ones that end at the last board are returned. They do not
    contain queues, because their writers determine how long messages wait in them.

    Returns:
        At least one row. All have the same length, which may be 0.

    Args:
        layout: Layout of the rack.
        boards: Names of the boards, in the order in which the information flows.
    """
    sampled = [
        box for box in layout.mailboxes if box.protocol != "queue" and not is_position_mailbox(box)
    ]
    return find_mailbox_rows(
        layout, boards[:-1], {box.name for box in sampled if boards[-1] in box.readers}
    )


def find_mailbox_rows(
    layout: Layout, boards: Sequence[str], taken: Collection[str]
) -> list[MailboxRow]:
    """Return the longest rows of mailboxes, one of each board, that end in `taken`.

    Each level reads one mailbox of a row and writes the next one. A row ends at the
    last board. It is shorter than `boards` if none begins at the first board, and may be empty.
    """
    last = [box for box in layout.mailboxes if box.writer in boards[-1:] and box.name in taken]
    rows = [
        (*row, box) for box in last for row in find_mailbox_rows(layout, boards[:-1], box.rests_on)
    ]
    longest = max(map(len, rows), default=0)
    return [row for row in rows if len(row) == longest] or [()]
