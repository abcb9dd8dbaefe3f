"""Finds the cause of each missed or skipped cycle, as far as the recording shows it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from pydantic import TypeAdapter

from rack.backplane.layout import TaskSpec
from rack.boards.timing.trace_times import (
    Occupation,
    count_skipped_releases,
    find_missed_cycles,
)
from rack.tools.console.answer import Document
from rack.tools.faults.ending import Strike
from rack.tools.faults.evidence import takes_cycles
from rack.tools.recording.recording import Recording
from rack.tools.timing.chain_response import LOSS_CODES

HYPERVISOR = "hypervisor"
CORE_TAKEN = "core taken from the rack"
OWN_EXECUTION = "own execution"
NOT_RECORDED = "not recorded"
SIMULATED_CORE = "simulated core busy"
Causes = dict[tuple[str, int], tuple[str, int]]
"""Cause of lost cycles and its duration in ns, by task and tick of the first lost cycle."""


def add_causes(
    recording: Recording, misses: Sequence[Document], absent: Mapping[int, Occupation]
) -> Iterator[Document]:
    """Yield the entries of `list_misses` with their causes.

    Args:
        recording: The run.
        misses: The entries.
        absent: Dictionary from core to the times at which it was absent, from `analyze_stalls`.

    Returns:
        The entries with `why`, and with `why_ms`, its duration, or None if it was not measured.
    """
    layout = recording.layout
    causes: Causes = {}
    if recording.rack_config.clock.mode == "realtime":
        for task in layout.tasks:
            causes |= _find_delays(recording, task, absent)
    strikes = TypeAdapter(tuple[Strike, ...]).validate_python(
        recording.end_counts.get("faults", ())
    )
    otherwise = SIMULATED_CORE if recording.rack_config.simulated_load else NOT_RECORDED
    for miss in misses:
        task = layout.find_task(miss["task"])
        why, ns = causes.get((task.name, miss["tick"]), (otherwise, 0))
        if fault := next(_list_faults(recording, task, miss, strikes), ""):
            why, ns = fault, 0
        # The kernel counts steal in steps that are longer than most delays.
        ms = ns / 1e6 if ns and why != HYPERVISOR else None
        yield {**miss, "why": why, "why_ms": ms}


def _find_delays(recording: Recording, task: TaskSpec, absent: Mapping[int, Occupation]) -> Causes:
    """Find the causes of a task's lost cycles in the times of its core and of its trace."""
    rows = recording.read_trace(task.name)
    due = recording.layout.compute_due_ticks(task)
    core, _ = recording.find_core_and_priority(task)
    grid_ns = recording.rack_config.tick_ns
    skipped = count_skipped_releases(rows)
    missed = find_missed_cycles(rows)
    since = rows["release_ns"] - skipped * task.every * grid_ns
    until = np.where(missed, rows["end_ns"], rows["start_ns"])
    spans = np.array(recording.cores.stolen or (), np.int64).reshape(-1, 4)
    # Releases are also skipped while the previous cycle is running.
    processor_ns = rows["processor_ns"]
    before_ns = np.where(np.roll(rows["end_ns"], 1) > since, np.roll(processor_ns, 1), 0)
    own_ns = np.maximum(np.where(missed, processor_ns, 0), before_ns)
    found = {
        HYPERVISOR: Occupation(*spans[spans[:, 2] == core, :2].T).compute_overlap(since, until),
        CORE_TAKEN: absent[core].compute_overlap(since, until) if len(rows) else since,
        OWN_EXECUTION: np.where(own_ns > due * grid_ns, own_ns, 0),
    }
    causes: Causes = {}
    for why, ns in found.items():
        for at in np.flatnonzero((missed | (skipped > 0)) & (ns > 0)):
            for tick in (rows["tick"][at], rows["tick"][at] - skipped[at] * task.every):
                causes.setdefault((task.name, int(tick)), (why, int(ns[at])))
    return causes


def _list_faults(
    recording: Recording, task: TaskSpec, miss: Document, strikes: Sequence[Strike]
) -> Iterator[str]:
    """Yield the faults and the losses of a board that took cycles from a task.

    Args:
        recording: The run.
        task: The task.
        miss: The lost cycles.
        strikes: All faults.
    """
    since, until = miss["tick"] - task.every, miss["tick"] + miss["count"] * task.every
    tasks = recording.layout.tasks
    cores = {other.name: recording.find_core_and_priority(other)[0] for other in tasks}
    for strike in strikes:
        is_active = 0 <= strike.first_tick <= until and not 0 <= strike.ends < since
        # The clock, which is no task, delays the tasks on all cores.
        is_near = cores.get(strike.board) in (None, cores[task.name])
        if is_active and is_near and takes_cycles(strike):
            yield f"fault '{strike.kind}' of {strike.board}"
    for event in recording.events:
        is_near = event.get("code") in LOSS_CODES and since <= event["tick"] <= until
        if is_near and task.board in (event["subject"], event["board"]):
            yield f"loss of {task.board}"
