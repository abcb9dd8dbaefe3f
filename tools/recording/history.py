"""What happened in a run: misses, what the machine did to its cores, and holds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.backplane.message import State
from rack.boards.timing.trace_times import is_missed, lasted_ns, lateness_ns, skipped
from rack.levels.operator import Operation
from rack.tools.console.answer import Document

if TYPE_CHECKING:
    from rack.tools.recording.recording import Recording

OWN = "holding"
"""`by` of a hold whose reason comes from the level itself."""


def misses(recording: Recording) -> list[Document]:
    """Return every miss in the trace, earliest first: task, tick, `what` ("late" or "skipped"),
    count, times.

    A skipped release leaves no record of its own: the next record has the number skipped before it.
    After the last record, the counts of the run's end show them.
    """
    found = []
    for task in recording.layout.tasks:
        found += _misses_of(task, recording.trace(task.name))
        done = recording.counts(task.name).get("done")
        if done is None:
            # The end is not recorded, or was by an earlier version.
            continue
        if count := task.count_unfinished(done, recording.ended["outcome"]["ticks"]):
            found.append(_skipped(task, task.grid.since(done + 1), count))
    return sorted(found, key=lambda miss: (miss["tick"], miss["task"]))


def _misses_of(task: TaskSpec, cycles: np.ndarray) -> list[Document]:
    rows = cycles[is_missed(cycles) | (skipped(cycles) > 0)]
    found = []
    columns = (
        rows["tick"],
        skipped(rows),
        is_missed(rows),
        lateness_ns(rows) * 1e-6,
        lasted_ns(rows) * 1e-6,
    )
    for tick, before, missed, late_ms, took_ms in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        if before:
            found.append(_skipped(task, tick - before * task.every, before))
        if missed:
            times = {"started_ms": round(late_ms, 6), "took_ms": round(took_ms, 6)}
            found.append({"task": task.name, "tick": tick, "what": "late", "count": 1, **times})
    return found


def _skipped(task: TaskSpec, tick: int, count: int) -> Document:
    return {"task": task.name, "tick": tick, "what": "skipped", "count": count}


def counted(found: Sequence[Document]) -> tuple[int, int]:
    """Return how many cycles of `misses` ended late, and how many were skipped."""
    late, left_out = (
        sum(miss["count"] for miss in found if miss["what"] == what) for what in ("late", "skipped")
    )
    return late, left_out


def steal(recording: Recording) -> Document:
    """Return the time stolen by the hypervisor, by core: ms, and `percent` of the run's time.

    In lockstep, and where the kernel does not count it, steal is not `measured`.
    """
    record = recording.cores
    stolen_ms = {str(core): ms for core, ms in record.stolen_ms().items()}
    percent = {core: round(1e8 * ms / record.lasted_ns, 3) for core, ms in stolen_ms.items()}
    return {"measured": record.stolen is not None, "ms": stolen_ms, "percent": percent}


def frequency(recording: Recording) -> dict[str, dict[str, float]] | None:
    """Return lowest and highest MHz by core; None where they were not measured."""
    return {str(core): {"min": low, "max": high} for core, low, high in recording.cores.mhz} or None


def holds(recording: Recording) -> list[Document]:
    """Return every hold, the earliest first; `until_s` is None where it lasted to the end of the
    run.

    `by` is "operator", with the command as `why`; or "holding", with the last reason that the level
    gave.
    """
    levels = [
        mailbox.removesuffix(".status")
        for mailbox in recording.mailboxes
        if mailbox.endswith(".status")
    ]
    found = [hold for level in levels for hold in _holds_of(recording, level)]
    return sorted(found, key=lambda hold: (hold["since_s"], hold["level"]))


def fired_rows(recording: Recording) -> dict[str, list[Document]]:
    """Return, by level with state tables, the rows that fired: table, row, name, cycles, and when
    first.
    """
    found = {}
    for mailbox in recording.mailboxes:
        if not {"table", "row", "fired"} <= recording.fields(mailbox):
            continue
        columns = ("table", "row", "fired")
        rows = [*zip(*(recording.signal(mailbox, name).tolist() for name in columns), strict=True)]
        times_s = recording.signal(mailbox, "tick") * recording.layout.clock_ns * 1e-9
        # Backwards, so that the earliest time of each row stays.
        first_s = dict(zip(reversed(rows), reversed(times_s.tolist()), strict=True))
        found[mailbox.removesuffix(".status")] = [
            {
                "table": table,
                "row": number,
                "name": name,
                "cycles": count,
                "first_s": round(first_s[table, number, name], 6),
            }
            # In the order in which they fired first.
            for (table, number, name), count in Counter(rows).items()
        ]
    return found


def _holds_of(recording: Recording, level: str) -> Iterator[Document]:
    mailbox = f"{level}.status"
    tick_s = recording.layout.clock_ns * 1e-9
    fields = recording.fields(mailbox)
    if "state" not in fields:
        return
    ticks = recording.signal(mailbox, "tick")
    own = recording.signal(mailbox, "state") == State.HOLDING
    standing = (
        recording.signal(mailbox, "standing").astype(int)
        if "standing" in fields
        else np.zeros(len(ticks), int)
    )
    # An operator's command takes precedence over the level's own state.
    what = np.where(standing > 0, standing, -own.astype(int))
    for first, end in _stretches(what):
        is_operators = what[first] > 0
        why = (
            Operation(what[first]).name.lower()
            if is_operators
            else recording.reason(mailbox, end - 1)
        )
        since, until = ticks[[first, min(end, len(ticks) - 1)]].tolist()
        yield {
            "level": level,
            "by": "operator" if is_operators else OWN,
            "why": why,
            "since_s": round(since * tick_s, 6),
            "until_s": round(until * tick_s, 6) if end < len(ticks) else None,
            "lasted_s": round((until - since) * tick_s, 6),
        }


def _stretches(what: np.ndarray) -> list[tuple[int, int]]:
    """Return the stretches of equal numbers other than 0, each as its first place and the one after
    its last.
    """
    borders = [0, *(np.flatnonzero(np.diff(what)) + 1).tolist(), len(what)]
    return [(first, end) for first, end in pairwise(borders) if first < end and what[first]]
