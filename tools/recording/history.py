"""History of a run: missed cycles, holds, fired rows, and steal and frequency of the cores."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.backplane.message import State, escape_text
from rack.boards.timing.trace_times import (
    compute_duration_ns,
    compute_lateness_ns,
    count_skipped_releases,
    find_missed_cycles,
)
from rack.levels.operator import Operation
from rack.tools.console.answer import Document

if TYPE_CHECKING:
    from rack.tools.recording.recording import Recording

BY_LEVEL = "holding"
"""Value of `by` for a hold that the level itself started."""


def list_misses(recording: Recording) -> list[Document]:
    """List every missed cycle of the trace, earliest first.

    A skipped release leaves no record: the next record of the task contains the number of
    releases skipped before it. Releases skipped after the last record follow from the counts at
    the end of the run.

    Returns:
        Entries with task, tick, `what` ("late" or "skipped") and count. Entries of late cycles
        also have the lateness and the duration in ms.
    """
    tasks = recording.layout.tasks
    entries = [entry for task in tasks for entry in _list_task_misses(recording, task)]
    return sorted(entries, key=lambda miss: (miss["tick"], miss["task"]))


def _list_task_misses(recording: Recording, task: TaskSpec) -> Iterator[Document]:
    """Yield the late cycles and skipped releases of one task."""
    cycles = recording.read_trace(task.name)
    rows = cycles[find_missed_cycles(cycles) | (count_skipped_releases(cycles) > 0)]
    columns = (
        rows["tick"],
        count_skipped_releases(rows),
        find_missed_cycles(rows),
        compute_lateness_ns(rows) * 1e-6,
        compute_duration_ns(rows) * 1e-6,
    )
    for tick, skipped_before, missed, late_ms, lasted_ms in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        if skipped_before:
            yield _build_skip_entry(task, tick - skipped_before * task.every, skipped_before)
        if missed:
            times = {"started_ms": round(late_ms, 6), "took_ms": round(lasted_ms, 6)}
            yield {"task": task.name, "tick": tick, "what": "late", "count": 1, **times}
    done = recording.find_task_counts(task.name).get("done")
    if done is None:
        # The end of the run was not recorded, or an earlier version recorded the run.
        return
    if count := task.count_unfinished(done, recording.end_counts["outcome"]["ticks"]):
        yield _build_skip_entry(task, task.grid.find_tick(done + 1), count)


def _build_skip_entry(task: TaskSpec, tick: int, count: int) -> Document:
    """Return the entry for `count` consecutive skipped releases of a task, the first at `tick`."""
    return {"task": task.name, "tick": tick, "what": "skipped", "count": count}


def count_misses(entries: Sequence[Document]) -> tuple[int, int]:
    """Return the number of late and the number of skipped cycles in entries of `list_misses`."""
    late, left_out = (
        sum(miss["count"] for miss in entries if miss["what"] == kind)
        for kind in ("late", "skipped")
    )
    return late, left_out


def summarize_gaps(recording: Recording) -> Document:
    """Return what a recording lacks: lost rows, gaps, untraced cycles, and ranges not kept."""
    return {
        "rows_lost": {name: count for name, count in recording.lost_rows.items() if count},
        "gaps": [gap._asdict() for gap in recording.find_gaps()],
        "untraced": recording.count_traced_cycles(),
        "kept": recording.kept_text or None,
    }


def summarize_steal(recording: Recording) -> Document:
    """Return the time that the hypervisor stole from each core.

    Returns:
        `ms` and `percent` (of the run), which are dictionaries keyed by core, and `measured`, which
        is False if the run was in lockstep or the kernel does not count steal.
    """
    record = recording.cores
    spans = record.stolen or ()
    stolen_ms = {
        str(core): sum(span.ms for span in spans if span.core == core)
        for core in sorted({span.core for span in spans})
    }
    percent = {core: round(1e8 * ms / record.lasted_ns, 3) for core, ms in stolen_ms.items()}
    return {"measured": record.stolen is not None, "ms": stolen_ms, "percent": percent}


def list_holds(recording: Recording) -> list[Document]:
    """List every hold of every level, earliest first.

    Returns:
        Entries with level, `by`, `why`, and the beginning, end and duration of the hold in s. If an
        operator commanded the hold, `by` is "operator" and `why` is the command. If the level
        itself began the hold, `by` is "holding" and `why` is the last reason in its status.
        `until_s` is None if the hold lasted until the end of the run.
    """
    statuses = [mailbox for mailbox in recording.mailboxes if mailbox.endswith(".status")]
    holds = [hold for mailbox in statuses for hold in _list_level_holds(recording, mailbox)]
    return sorted(holds, key=lambda hold: (hold["since_s"], hold["level"]))


def list_fired_rows(recording: Recording) -> dict[str, list[Document]]:
    """List the rows of state tables that fired at least once.

    Returns:
        Dictionary from level to its rows, in the order in which they first fired. Each entry has
        table, row, name, number of cycles in which the row fired, and simulated time at which it
        first fired.
    """
    by_level = {}
    for mailbox in recording.mailboxes:
        if not {"table", "row", "fired"} <= recording.list_fields(mailbox):
            continue
        columns = [recording.read_signal(mailbox, name) for name in ("table", "row", "fired")]
        rows = [*zip(*(column.tolist() for column in columns), strict=True)]
        times_s = recording.read_signal(mailbox, "tick") * recording.layout.clock_ns * 1e-9
        # Iterate backwards, so that the dictionary keeps the earliest time of each row.
        first_s = dict(zip(reversed(rows), reversed(times_s.tolist()), strict=True))
        by_level[mailbox.removesuffix(".status")] = [
            {
                "table": table,
                "row": number,
                "name": name,
                "cycles": count,
                "first_s": round(first_s[table, number, name], 6),
            }
            # `Counter` keeps the order in which the rows first fired.
            for (table, number, name), count in Counter(rows).items()
        ]
    return by_level


def _list_level_holds(recording: Recording, mailbox: str) -> Iterator[Document]:
    """Yield the holds of the level that writes its statuses to this mailbox."""
    tick_s = recording.layout.clock_ns * 1e-9
    fields = recording.list_fields(mailbox)
    if "state" not in fields:
        return
    ticks = recording.read_signal(mailbox, "tick")
    is_level_holding = recording.read_signal(mailbox, "state") == State.HOLDING
    standing_commands = (
        recording.read_signal(mailbox, "standing").astype(int)
        if "standing" in fields
        else np.zeros(len(ticks), int)
    )
    # An operator's command takes precedence over the level's own state.
    hold_codes = np.where(standing_commands > 0, standing_commands, -is_level_holding.astype(int))
    borders = [0, *(np.flatnonzero(np.diff(hold_codes)) + 1).tolist(), len(ticks)]
    for first, end in pairwise(borders):
        if first == end or not hold_codes[first]:
            continue
        is_operators = hold_codes[first] > 0
        why = ""
        if is_operators:
            why = Operation(hold_codes[first]).name.lower()
        elif "reason" in fields:
            why = escape_text(str(recording.read_signal(mailbox, "reason")[end - 1]))
        since, until = ticks[[first, min(end, len(ticks) - 1)]].tolist()
        yield {
            "level": mailbox.removesuffix(".status"),
            "by": "operator" if is_operators else BY_LEVEL,
            "why": why,
            "since_s": round(since * tick_s, 6),
            "until_s": round(until * tick_s, 6) if end < len(ticks) else None,
            "lasted_s": round((until - since) * tick_s, 6),
        }
