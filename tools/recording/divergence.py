"""Where two runs diverge: of each mailbox the first message that is not the same in both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.tools.console.answer import Failure
from rack.tools.recording.file_names import CONFIG
from rack.tools.recording.origin import Origin
from rack.tools.recording.recording import Recording

HEADS = ("serial", "tick", "visible_at", "chain")
"""Columns by which messages are compared: the chain of each covers all that was written before
it."""
Heads = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Difference:
    """Where two runs diverge: the release tick of the first message that differs, and its
    mailbox.
    """

    tick: int
    mailbox: str


@dataclass(frozen=True)
class UnlikeMessage:
    """The first message of a mailbox that is not the same in two runs.

    `tick` is that of the cycle that wrote it, `visible_at` the tick from which it is read: where
    they differ, or one run lacks the message, the earlier one.
    """

    mailbox: str
    serial: int
    tick: int
    visible_at: int


def other_run(run: Path, named: Path, asked: str = "") -> Path:
    """Return the folder of the run that one is compared with: the one `named` or, for "origin", the
    one that it goes on from, where its user named it or next to it. Raises `Failure`, which begins
    with what was `asked`.
    """
    if str(named) != "origin":
        return named
    asked = f"{asked or '--against origin'}: {run}"
    origin = Origin.of(Recording(run))
    if origin is None:
        raise Failure(f"{asked} records no run that it goes on from; permitted: --against RUN", 2)
    there = Path(origin.folder)
    for folder in (there, run.resolve().parent / there.name):
        if (folder / CONFIG).is_file() and origin.is_of(Recording(folder)):
            return folder
    raise Failure(f"{asked} goes on from {there}, and that run is not there any more", 2)


def first_difference(one: Recording, other: Recording) -> Difference | None:
    """Return where two runs diverge, up to the end of the shorter one; None when all that both
    wrote is equal. Raises `Failure` as `unlike_messages` does.
    """
    found = unlike_messages(one, other)
    return Difference(found[0].tick, found[0].mailbox) if found else None


def unlike_messages(one: Recording, other: Recording) -> list[UnlikeMessage]:
    """Return of each mailbox the first message that differs, if any, in the order of ticks.

    Raises `Failure` when the two runs are of different racks, or either lacks rows.
    """
    for run in (one, other):
        _check_whole(run)
    _check_alike(one, other)
    begin, end = common_ticks(one, other)
    written = {*one.mailboxes, *other.mailboxes}
    boxes = {box.name for box in other.layout.timed} & written
    found = [
        unlike
        for box in one.layout.timed
        if box.name in boxes and (unlike := _unlike(one, other, box, begin, end)) is not None
    ]
    return sorted(found, key=lambda unlike: unlike.tick)


def ticks_of(recording: Recording) -> tuple[int, int]:
    """Return the ticks of a recorded run, [first, end)."""
    found = [rows["tick"] for rows in recording.cycles.values()]
    end: int = recording.ended.get("outcome", {}).get("ticks", 0)
    end = end or max((int(ticks[-1]) + 1 for ticks in found), default=0)
    return min((int(ticks[0]) for ticks in found), default=0), end


def common_ticks(one: Recording, other: Recording) -> tuple[int, int]:
    """Return the ticks that two runs have in common, [first, end): one that goes on from another
    begins later.
    """
    begins, ends = zip(ticks_of(one), ticks_of(other), strict=True)
    return max(begins), min(ends)


def _check_whole(recording: Recording) -> None:
    if recording.kept:
        why = recording.kept_text
    elif lost := sum(recording.lost.values()):
        why = f"its recorder lost {lost} rows"
    else:
        return
    raise Failure(f"{recording.folder}: {why}; the two runs cannot be compared", 2)


def _check_alike(one: Recording, other: Recording) -> None:
    both = f"{one.folder} and {other.folder}"
    boards, others = ([task.board for task in run.layout.tasks] for run in (one, other))
    # A rack may have a board more, as one that watches.
    if not ({*boards} <= {*others} or {*others} <= {*boards}):
        lone = next(board for board in boards if board not in others)
        raise Failure(f"{both} are of different racks: only the first has '{lone}'", 2)
    boxes = {box.name: box for box in other.layout.timed}
    for box in one.layout.timed:
        if box.name in boxes and box.fields != boxes[box.name].fields:
            raise Failure(f"{both} are of different racks: {box.name} has other fields", 2)
    if not {*one.mailboxes} & {*other.mailboxes}:
        raise Failure(f"{both} have no mailbox in common", 2)


def _unlike(
    one: Recording, other: Recording, box: MailboxSpec, begin: int, end: int
) -> UnlikeMessage | None:
    heads = [_heads(run, box.name, begin) for run in (one, other)]
    length = min(len(head["serial"]) for head in heads)
    apart, chained = (
        next(iter(np.flatnonzero(here[:length] != there[:length]).tolist()), length)
        for here, there in ((heads[0][name], heads[1][name]) for name in ("serial", "chain"))
    )
    # A damaged message is in no recording: the serials are apart where it was. Of any other the
    # chain shows a difference one message later.
    first = apart if apart <= chained else max(chained - 1, 0)
    if first == length > 0 and not _is_last_equal(one, other, box, heads):
        first -= 1
    found = [
        tuple(int(head[name][first]) for name in HEADS[:-1])
        for head in heads
        if first < len(head["serial"])
    ]
    if not found:
        return None
    serial, tick, visible_at = (min(numbers) for numbers in zip(*found, strict=True))
    # The other run may have ended before it would have written that message.
    if len(found) == 1 and visible_at >= end:
        return None
    return UnlikeMessage(box.name, serial, tick, visible_at)


def _heads(run: Recording, mailbox: str, begin: int) -> Heads:
    """Return the heads of the messages written from tick `begin` on."""
    columns = {name: run.signal(mailbox, name) for name in HEADS}
    is_later = columns["tick"] >= begin
    return {name: values[is_later] for name, values in columns.items()}


def _is_last_equal(one: Recording, other: Recording, box: MailboxSpec, heads: list[Heads]) -> bool:
    """Say whether the last message that both have is equal: no chain covers it yet."""
    at = min(len(head["serial"]) for head in heads) - 1
    if any(heads[0][name][at] != heads[1][name][at] for name in HEADS):
        return False
    found = (row_of(run, box, int(heads[0]["serial"][at])) for run in (one, other))
    return len({row["message"].tobytes() for row in found}) == 1


def row_of(run: Recording, box: MailboxSpec, serial: int) -> Any:
    """Return the row of a message; None where the recording has none of that serial."""
    rows = run.rows(box.name)
    at = np.flatnonzero(rows["serial"] == serial)
    return rows[at[0]] if len(at) else None
