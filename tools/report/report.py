"""Collects the report of a run, report.json and report.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from rack.backplane.layout import Layout, TaskSpec
from rack.boards.config import RackConfig, wire
from rack.boards.timing.trace_times import distribution, plan_ages
from rack.levels.peer import Presence, peer_port
from rack.tools.console.answer import Document, write_file, write_json
from rack.tools.faults.judge import faults
from rack.tools.launch.verdict import UNRECORDED, judge_run
from rack.tools.monitor.host_side import ENTRY_COUNTS, entries_of
from rack.tools.monitor.interrupts import interrupts
from rack.tools.monitor.network import BOARD, COUNTS, STATUS, exchanged
from rack.tools.monitor.queues import queues
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.folder_size import sizes
from rack.tools.recording.history import (
    counted,
    fired_rows,
    frequency,
    holds,
    misses,
    steal,
)
from rack.tools.recording.origin import Origin
from rack.tools.recording.recording import Recording
from rack.tools.recording.stalls import stalls_of
from rack.tools.report import arm_outcome
from rack.tools.report.report_markdown import markdown
from rack.tools.report.run_report import RunReport
from rack.tools.report.task_times import task_times
from rack.tools.timing.measured_response import system_response

COMPARISON = "rack.tools.report.against"
"""Module that compares two runs, by name, since it needs code that reports on one run do not."""


@dataclass(frozen=True)
class OtherRun:
    """The run with which a report compares its own.

    Attributes:
        folder: Folder of the other run.
        mailbox: Mailbox whose first difference is explained, or "" for the earliest difference.
        may_repeat: Whether both runs may be repeated to find the cause.
    """

    folder: Path
    of: str
    repeats: bool


def write_report(folder: Path, against: OtherRun | None = None) -> tuple[Document, str]:
    """Write report.json and report.md into the folder of a run.

    Args:
        folder: Folder of the run.
        against: A run to compare with. The report then says where and why the two diverge.

    Returns:
        The report as data and as text.
    """
    recording = Recording(folder)
    report = report_of(recording)
    report |= sizes(folder, report["simulated_s"])
    if against is not None:
        report["against"] = import_module(COMPARISON).compared(recording, against)
    text = markdown(report)
    write_json(folder / "report.json", report)
    write_file(folder / "report.md", text)
    Checksums(folder).store("report.*")
    return report, text


def report_of(recording: Recording) -> Document:
    """Return the report of a recorded run as plain data."""
    config = recording.rack_config
    layout = recording.layout
    ended = recording.ended
    recording.adopt_kinds()
    origin = Origin.of(recording)
    missed_cycles = misses(recording)
    last_tick = max((int(rows["tick"][-1]) for rows in recording.cycles.values()), default=-1)
    response = system_response(recording)
    report = _head(config, ended, last_tick + 1, response)
    if not ended:
        # The end of the run is not recorded, so count the misses in the trace.
        missed, skipped = counted(missed_cycles)
        report = replace(report, missed=missed, skipped=skipped)
    return replace(
        report,
        folder=str(recording.folder),
        continues=None if origin is None else origin.document(layout.clock_ns),
        misses=missed_cycles,
        steal=steal(recording),
        stalls=asdict(stalls_of(recording)[0]),
        frequency_mhz=frequency(recording),
        notes=[event["text"] for event in recording.events if event["kind"] == "ready"],
        holds=holds(recording),
        state_tables=fired_rows(recording),
        **faults(recording.events, layout),
        tasks={task.name: _task(recording, config, task) for task in layout.tasks},
        system_response=response,
        entries=_entries(recording),
        network=network(recording),
        task=arm_outcome.task_outcome(recording),
        objects=list(arm_outcome.objects(recording, config)),
        motion=arm_outcome.motion(recording),
        hand=arm_outcome.hand(recording, config),
        force=arm_outcome.force(recording),
        queues=queues(recording),
        interrupts=interrupts(recording),
        recording=ended.get("recording", "without the end of the run"),
        rows_lost={name: count for name, count in recording.lost.items() if count},
        gaps=[gap._asdict() for gap in recording.gaps()],
        untraced=recording.untraced(),
        kept=recording.kept_text or None,
    ).document()


def unrecorded(config: RackConfig, ended: Mapping[str, Any]) -> Document:
    """Return the report of a run without a recording.

    It has the same keys, but null for everything that needs a recording.
    """
    layout = wire(config)
    head = _head(config, ended, 0, None)
    return replace(
        head,
        unjudged=[*head.unjudged, UNRECORDED],
        tasks={
            task.name: {**_about(task, layout), **ended["tasks"][task.name]}
            for task in layout.tasks
        },
        recording=ended["recording"],
    ).document()


def _head(
    config: RackConfig, ended: Mapping[str, Any], ticks: int, response: Document | None
) -> RunReport:
    """Return the part of a report that needs no recording.

    Args:
        config: Config of the run.
        ended: Counts at the end of the run. Empty if the end is not known.
        ticks: Length of a run whose end is not known.
        response: Measured response of the system, or None.
    """
    outcome = ended.get("outcome", {})
    counters = ended.get("tasks", {}).values()
    return RunReport(
        rack=config.name,
        mode=config.clock.mode,
        speed=config.clock.speed,
        clock_ms=config.clock.period_ms,
        **judge_run(ended, response),
        outcome=outcome or None,
        digest=outcome.get("digest"),
        objects=outcome.get("objects", []),
        simulated_s=round(outcome.get("ticks", ticks) * config.clock_ns * 1e-9, 6),
        wall_s=round(ended.get("wall_s", 0.0), 6),
        clock_skipped=ended.get("clock_skipped", 0),
        missed=sum(task["missed"] for task in counters),
        skipped=sum(task["skipped"] for task in counters),
    )


def _task(recording: Recording, config: RackConfig, task: TaskSpec) -> Document:
    """Return the entry of a task: its place in the rack, counts and times."""
    is_lockstep = config.clock.mode == "lockstep"
    layout = recording.layout
    cycles = recording.trace(task.name)
    stretches = recording.stretch_of(cycles["tick"])
    period_ns = layout.clock_ns if is_lockstep else config.tick_ns
    entry = {
        **_about(task, layout),
        **recording.counts(task.name),
        **task_times(task, cycles, period_ns, is_lockstep, stretches=stretches),
    }
    if task.role == "executor" and f"{task.board}.plan" in recording.mailboxes:
        entry["plan_age_ms"] = distribution(plan_ages_ms(recording, task.board))
    return entry


def plan_ages_ms(recording: Recording, board: str) -> np.ndarray:
    """Return the age of the plan that each cycle of an executor could read, in simulated time.

    See `plan_ages`.
    """
    plan = f"{board}.plan"
    plan_ticks = recording.signal(plan, "tick")
    visible_at = recording.signal(plan, "visible_at")
    ticks = recording.trace(board)["tick"]
    cycle_stretches = recording.stretch_of(ticks)
    plan_stretches = recording.stretch_of(plan_ticks)
    ages = [
        plan_ages(
            ticks[cycle_stretches == stretch],
            plan_ticks[plan_stretches == stretch],
            visible_at[plan_stretches == stretch],
        )
        for stretch in np.unique(plan_stretches)
    ]
    return np.concatenate(ages) * (recording.layout.clock_ns * 1e-6)


def _about(task: TaskSpec, layout: Layout) -> Document:
    """Return role, slot and rate of a task."""
    return {"role": task.role, "slot": task.slot, "rate_hz": 1e9 / (task.every * layout.clock_ns)}


def _entries(recording: Recording) -> list[Document]:
    """Return the entries of all bus adapters: their final counts and the ages of messages, ms."""
    entries = []
    tick_ms = recording.layout.clock_ns * 1e-6
    for mailbox, entry, source in entries_of(recording.layout, recording.config):
        if mailbox in recording.mailboxes:
            ages = recording.signal(mailbox, f"{entry}.age")
            counts = {name: _last(recording, mailbox, f"{entry}.{name}") for name in ENTRY_COUNTS}
            name = f"{mailbox.partition('.')[0]}.{entry}"
            ages_ms = distribution(ages[ages >= 0] * tick_ms)
            entries.append({"entry": name, "source": source, **counts, "age_ms": ages_ms})
    return entries


def network(recording: Recording) -> Document | None:
    """Return the traffic with other racks, with ages in ms, and the losses of these racks.

    None if the rack has no network adapter, or nothing of it was recorded.
    """
    exchange = exchanged(recording.config)
    if exchange is None or STATUS not in recording.mailboxes:
        return None
    imports = []
    for port, source in exchange.imports.items():
        ages_s = recording.signal(STATUS, f"import_{port}.age_s")
        counts = {name: _last(recording, STATUS, f"import_{port}.{name}") for name in COUNTS}
        # The age at every cycle of the adapter. It grows until the next message comes.
        ages = distribution(ages_s[ages_s >= 0.0] * 1e3)
        imports.append({"entry": f"{BOARD}.{port}", "source": source, **counts, "age_ms": ages})
    exports = [
        {
            "entry": f"{BOARD}.{port}",
            "source": source,
            "sent": _last(recording, STATUS, f"export_{port}.sent"),
        }
        for port, source in exchange.exports.items()
    ]
    peers = [_peer(recording, rack) for rack in exchange.peers]
    return {"imports": imports, "exports": exports, "peers": peers}


def _peer(recording: Recording, rack: str) -> Document:
    """Return the final state of another rack, and how often and how long it was lost."""
    mailbox = f"{BOARD}.{peer_port(rack)}"
    presence = recording.signal(mailbox, "presence")
    cycle_s = recording.layout.task(BOARD).every * recording.layout.clock_ns * 1e-9
    return {
        "peer": rack,
        "state": Presence(int(presence[-1])).name.lower(),
        "losses": _last(recording, mailbox, "losses"),
        "restarts": max(0, _last(recording, mailbox, "launches") - 1),
        "lost_s": round(float((presence == Presence.LOST).sum() * cycle_s), 6),
    }


def _last(recording: Recording, mailbox: str, count: str) -> int:
    """Return a count in the last message of a mailbox."""
    return int(recording.signal(mailbox, count)[-1])
