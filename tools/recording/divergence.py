"""Finds the first message of each mailbox that differs between two runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.slots import CHECKED_FROM
from rack.backplane.trace import SKIPPED_SHIFT
from rack.tools.console.answer import Failure
from rack.tools.recording.file_names import CONFIG
from rack.tools.recording.origin import Origin
from rack.tools.recording.recording import Recording


@dataclass(frozen=True)
class Difference:
    """The first difference between two runs.

    Attributes:
        tick: Release tick of the cycle that wrote the first differing message.
        mailbox: Mailbox of that message.
    """

    tick: int
    mailbox: str


@dataclass(frozen=True)
class DivergentMessage:
    """The first message of a mailbox that differs between two runs.

    If a serial or tick differs between the runs, the smaller value is stored.

    Attributes:
        mailbox: The mailbox.
        serial: Serial of the message.
        tick: Release tick of the cycle that wrote it.
        visible_at: Tick from which it can be read.
    """

    mailbox: str
    serial: int
    tick: int
    visible_at: int


def find_other_run(run: Path, named: Path, asked: str = "") -> Path:
    """Return the folder of the run to compare `run` with.

    Args:
        run: Folder of the run.
        named: Folder of the other run, or "origin" for the run that `run` continues. The origin is
            looked for at its recorded path, then next to `run`.
        asked: Command line option or request that is named at the beginning of error messages.

    Raises:
        Failure: The origin was requested, but `run` has none, or it no longer exists.
    """
    if str(named) != "origin":
        return named
    asked = f"{asked or '--against origin'}: {run}"
    origin = Origin.read_from(Recording(run))
    if origin is None:
        raise Failure(f"{asked} does not continue another run; name one with --against RUN", 2)
    origin_folder = Path(origin.folder)
    for folder in (origin_folder, run.resolve().parent / origin_folder.name):
        is_run = (folder / CONFIG).is_file()
        if is_run and Recording(folder).launch.created_ns == origin.launched_ns:
            return folder
    raise Failure(f"{asked} continues {origin_folder}, but that run no longer exists", 2)


def find_first_difference(first_run: Recording, second_run: Recording) -> Difference | None:
    """Return the first difference between two runs, or None if all compared messages are equal.

    Only ticks that both runs contain are compared.

    Raises:
        Failure: The runs are of different racks, or one of them lacks rows.
    """
    messages = list_divergent_messages(first_run, second_run)
    return Difference(messages[0].tick, messages[0].mailbox) if messages else None


def list_divergent_messages(first_run: Recording, second_run: Recording) -> list[DivergentMessage]:
    """Return the first differing message of each mailbox that differs, sorted by tick.

    Raises:
        Failure: The runs are of different racks, or one of them lacks rows.
    """
    for run in (first_run, second_run):
        _check_complete(run)
    _check_comparable(first_run, second_run)
    begin, end = find_common_ticks(first_run, second_run)
    written = {*first_run.mailboxes, *second_run.mailboxes}
    boxes = {box.name for box in second_run.layout.timed} & written
    messages = [
        unlike
        for box in first_run.layout.timed
        if box.name in boxes
        and (unlike := _find_divergent_message(first_run, second_run, box, begin, end)) is not None
    ]
    return sorted(messages, key=lambda unlike: unlike.tick)


def find_tick_range(recording: Recording) -> tuple[int, int]:
    """Return the range of ticks of a recorded run: its first tick, and the tick after its last.

    The first record of a task contains the number of releases skipped before it. A run whose clock
    was late at its start therefore begins at its first release, not at its first cycle.
    """
    begins, ends = [], []
    for name, rows in recording.cycles.items():
        skipped = int(rows["flags"][0]) >> SKIPPED_SHIFT
        begins.append(int(rows["tick"][0]) - skipped * recording.layout.find_task(name).every)
        ends.append(int(rows["tick"][-1]) + 1)
    end: int = recording.end_counts.get("outcome", {}).get("ticks", 0)
    end = end or max(ends, default=0)
    if (origin := Origin.read_from(recording)) is not None:
        # Cycles that the original run began may end in the continuation.
        return origin.tick, end
    return min(begins, default=0), end


def find_common_ticks(first_run: Recording, second_run: Recording) -> tuple[int, int]:
    """Return the range of ticks that two runs have in common: the first, and one past the last.

    The ranges differ, for example, if one run continues the other from a later tick.
    """
    begins, ends = zip(find_tick_range(first_run), find_tick_range(second_run), strict=True)
    return max(begins), min(ends)


def _check_complete(recording: Recording) -> None:
    """Raise `Failure` if rows are missing from a recording."""
    if recording.kept:
        why = recording.kept_text
    elif lost := sum(recording.lost_rows.values()):
        why = f"its recorder lost {lost} rows"
    else:
        return
    raise Failure(f"{recording.folder}: {why}; the two runs cannot be compared", 2)


def _check_comparable(first_run: Recording, second_run: Recording) -> None:
    """Raise `Failure` if the racks of two runs cannot be compared.

    The boards of one rack must include all boards of the other. Mailboxes that both racks have must
    have equal fields, and at least one mailbox must be recorded in both runs.
    """
    both = f"{first_run.folder} and {second_run.folder}"
    boards, others = ([task.board for task in run.layout.tasks] for run in (first_run, second_run))
    # One rack may have additional boards, for example a board that only monitors.
    if not ({*boards} <= {*others} or {*others} <= {*boards}):
        extra_board = next(board for board in boards if board not in others)
        raise Failure(f"{both} are of different racks: only the first has '{extra_board}'", 2)
    boxes = {box.name: box for box in second_run.layout.timed}
    for box in first_run.layout.timed:
        if box.name in boxes and box.fields != boxes[box.name].fields:
            raise Failure(f"{both} are of different racks: {box.name} has other fields", 2)
    if not {*first_run.mailboxes} & {*second_run.mailboxes}:
        raise Failure(f"{both} have no mailbox in common", 2)


def _find_divergent_message(
    first_run: Recording, second_run: Recording, box: MailboxSpec, begin: int, end: int
) -> DivergentMessage | None:
    """Return the first differing message of a mailbox, or None if no message differs.

    Args:
        first_run: One run.
        second_run: The other run.
        box: The mailbox.
        begin: First tick that is compared.
        end: Tick before which the comparison ends.
    """
    recorded = (run.read_rows(box.name) for run in (first_run, second_run))
    # Take slices, because a selection by a mask does not copy the padding between fields.
    both = [rows[np.searchsorted(rows["tick"], begin) :] for rows in recorded]
    length = min(map(len, both))
    here, there = (
        rows[:length].view(np.uint8).reshape(length, rows.itemsize)[:, CHECKED_FROM:]
        for rows in both
    )
    # If the common rows are equal, the difference is the first row of the longer run.
    first = next(iter(np.flatnonzero((here != there).any(axis=1)).tolist()), length)
    messages = [rows[first] for rows in both if first < len(rows)]
    if not messages:
        return None
    serial, tick, visible_at = (
        min(int(message[name]) for message in messages) for name in ("serial", "tick", "visible_at")
    )
    # If the other run ended before the message became visible, the message is not expected there.
    if len(messages) == 1 and visible_at >= end:
        return None
    return DivergentMessage(box.name, serial, tick, visible_at)


def find_row(run: Recording, box: MailboxSpec, serial: int) -> Any:
    """Return the recorded row of the message with this serial, or None if it is not recorded."""
    rows = run.read_rows(box.name)
    matches = np.flatnonzero(rows["serial"] == serial)
    return rows[matches[0]] if len(matches) else None
