"""report.json and report.md of one run."""

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
"""What compares two runs, by name: it brings what repeats them, which no report on one needs."""


@dataclass(frozen=True)
class OtherRun:
    """The run in a folder that one is compared with: from where the mailbox `of` first differs, or
    any; and whether both may be repeated.
    """

    folder: Path
    of: str
    repeats: bool


def write_report(folder: Path, against: OtherRun | None = None) -> tuple[Document, str]:
    """Write the report of the run in `folder` into it, and return it as data and as text.

    With another run, `against`, it says where the two diverge, and why.
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
    found = misses(recording)
    last = max((int(rows["tick"][-1]) for rows in recording.cycles.values()), default=-1)
    response = system_response(recording)
    report = _head(config, ended, last + 1, response)
    if not ended:
        # Without the end of the run in the recording, the trace has to do.
        missed, skipped = counted(found)
        report = replace(report, missed=missed, skipped=skipped)
    return replace(
        report,
        folder=str(recording.folder),
        continues=None if origin is None else origin.document(layout.clock_ns),
        misses=found,
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
    """Return the report of a run that was not recorded: the same keys, null where only a recording
    could tell.
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
    """Return the part that needs no recording; `ticks` is the length of a run whose end is not
    known.
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
    """Return the age of the plan that each cycle of a board's executor could read, simulated time;
    see `plan_ages`.
    """
    plan = f"{board}.plan"
    made = recording.signal(plan, "tick")
    visible_at = recording.signal(plan, "visible_at")
    ticks = recording.trace(board)["tick"]
    own = recording.stretch_of(ticks)
    plans = recording.stretch_of(made)
    found = [
        plan_ages(ticks[own == at], made[plans == at], visible_at[plans == at])
        for at in np.unique(plans)
    ]
    return np.concatenate(found) * (recording.layout.clock_ns * 1e-6)


def _about(task: TaskSpec, layout: Layout) -> Document:
    return {"role": task.role, "slot": task.slot, "rate_hz": 1e9 / (task.every * layout.clock_ns)}


def _entries(recording: Recording) -> list[Document]:
    """Return the entries of all bus adapters: their counts at the end, and the ages of what passed,
    ms.
    """
    found = []
    tick_ms = recording.layout.clock_ns * 1e-6
    for mailbox, entry, source in entries_of(recording.layout, recording.config):
        if mailbox in recording.mailboxes:
            ages = recording.signal(mailbox, f"{entry}.age")
            counts = {name: _last(recording, mailbox, f"{entry}.{name}") for name in ENTRY_COUNTS}
            name = f"{mailbox.partition('.')[0]}.{entry}"
            ages_ms = distribution(ages[ages >= 0] * tick_ms)
            found.append({"entry": name, "source": source, **counts, "age_ms": ages_ms})
    return found


def network(recording: Recording) -> Document | None:
    """Return counts and ages, ms, of what passed, and losses of other racks; None: no adapter, or
    nothing recorded.
    """
    entries = exchanged(recording.config)
    if entries is None or STATUS not in recording.mailboxes:
        return None
    imports = []
    for port, source in entries.imports.items():
        ages_s = recording.signal(STATUS, f"import_{port}.age_s")
        counts = {name: _last(recording, STATUS, f"import_{port}.{name}") for name in COUNTS}
        # In every cycle of the adapter, not of each message: between two it grows.
        ages = distribution(ages_s[ages_s >= 0.0] * 1e3)
        imports.append({"entry": f"{BOARD}.{port}", "source": source, **counts, "age_ms": ages})
    exports = [
        {
            "entry": f"{BOARD}.{port}",
            "source": source,
            "sent": _last(recording, STATUS, f"export_{port}.sent"),
        }
        for port, source in entries.exports.items()
    ]
    peers = [_peer(recording, rack) for rack in entries.peers]
    return {"imports": imports, "exports": exports, "peers": peers}


def _peer(recording: Recording, rack: str) -> Document:
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
