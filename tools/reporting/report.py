"""report.json and report.md of one run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rack.backplane.layout import Layout, TaskSpec
from rack.backplane.message import State
from rack.boards.config import RackConfig, wire
from rack.tools.faults.judge import faults
from rack.tools.recording import Recording
from rack.tools.reporting.difference import first_difference
from rack.tools.reporting.holds import holds
from rack.tools.reporting.markdown import markdown
from rack.tools.reporting.misses import counted, misses
from rack.tools.reporting.motion import motion
from rack.tools.reporting.response import system_response
from rack.tools.reporting.steal import steal
from rack.tools.reporting.timing import plan_age_ms, task_times
from rack.tools.snapshot import TASK_STATUS

Report = dict[str, Any]


def write_report(folder: Path, against: Path | None = None) -> tuple[Report, str]:
    """Make the report of the run in `folder`, write it there, and return it as data and as text.

    With the folder of another run `against`, it says where the two diverge.
    """
    recording = Recording(folder)
    report = report_of(recording)
    if against is not None:
        report["against"] = _compared(recording, Recording(against), report["misses"])
    text = markdown(report)
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    (folder / "report.md").write_text(text)
    return report, text


def report_of(recording: Recording) -> Report:
    """Return the report of a recorded run as plain data."""
    config, layout = recording.rack_config, recording.layout
    ended, found = recording.ended, misses(recording, layout)
    report = _head(config, ended, _last_tick(recording) + 1)
    if not ended:
        # A recording that did not see the end of its run has what it traced.
        report["missed"], report["skipped"] = counted(found)
    counters = ended.get("tasks", {})
    return {
        **report,
        "folder": str(recording.folder),
        "misses": found,
        "steal": steal(recording, layout),
        "notes": [event["text"] for event in recording.events if event["kind"] == "ready"],
        "holds": holds(recording, layout),
        **faults(recording, layout),
        "tasks": {task.name: _task(recording, config, layout, task, counters) for task in layout.tasks},
        "system_response": system_response(recording, config, layout),
        "task": _task_outcome(recording, layout),
        "motion": motion(recording, layout),
        "recording": ended.get("recording", "without the end of the run"),
        "rows_lost": {name: count for name, count in recording.lost.items() if count},
    }


def unrecorded(config: RackConfig, ended: Mapping[str, Any]) -> Report:
    """Return the report of a run that nobody recorded: the same keys; null is what only a recording knows."""
    unknown = (
        *("misses", "steal", "notes", "holds", "faults", "unexplained", "restarts"),
        *("system_response", "task", "motion", "rows_lost"),
    )
    layout = wire(config)
    tasks = {task.name: {**_about(task, layout), **ended["tasks"][task.name]} for task in layout.tasks}
    head = _head(config, ended, 0)
    return {**head, **dict.fromkeys(unknown), "folder": None, "tasks": tasks, "recording": ended["recording"]}


def _head(config: RackConfig, ended: Mapping[str, Any], ticks: int) -> Report:
    """Return what is known of a run without its recording; `ticks` is its length where its end is not known."""
    outcome, counters = ended.get("outcome", {}), ended.get("tasks", {}).values()
    return {
        "rack": config.name,
        "folder": None,
        "mode": config.clock.mode,
        "speed": config.clock.speed,
        "clock_ms": config.clock.period_ms,
        "worked": ended.get("worked", False),
        "outcome": outcome or None,
        "digest": outcome.get("digest"),
        "simulated_s": round(outcome.get("ticks", ticks) * config.clock_ns * 1e-9, 6),
        "wall_s": round(ended.get("wall_s", 0.0), 6),
        "clock_skipped": ended.get("clock_skipped", 0),
        "missed": sum(task["missed"] for task in counters),
        "skipped": sum(task["skipped"] for task in counters),
    }


def _compared(recording: Recording, other: Recording, found: list[Report]) -> Report:
    parting = first_difference(recording, other)
    missed = min((miss["tick"] for miss in [*found, *misses(other, other.layout)]), default=None)
    return {
        "folder": str(other.folder),
        "first_difference": asdict(parting) if parting is not None else None,
        "first_miss_tick": missed,
        "explained": parting is None or (missed is not None and missed <= parting.tick),
    }


def _task(
    recording: Recording, config: RackConfig, layout: Layout, task: TaskSpec, counters: dict[str, dict[str, int]]
) -> Report:
    is_lockstep = config.clock.mode == "lockstep"
    period_ns = layout.clock_ns if is_lockstep else round(layout.clock_ns / config.clock.speed)
    cycles = recording.cycles.get(task.name, recording.no_cycles)
    entry: Report = {
        **_about(task, layout),
        **counters.get(task.name, {}),
        **task_times(task, cycles, period_ns, is_lockstep),
    }
    plan = f"{task.board}.plan"
    if task.role == "executor" and plan in recording.mailboxes:
        made, visible_at = recording.signal(plan, "tick"), recording.signal(plan, "visible_at")
        entry["plan_age_ms"] = plan_age_ms(cycles["tick"], made, visible_at, layout.clock_ns * 1e-6)
    return entry


def _about(task: TaskSpec, layout: Layout) -> Report:
    return {"role": task.role, "slot": task.slot, "rate_hz": 1e9 / (task.every * layout.clock_ns)}


def _last_tick(recording: Recording) -> int:
    return max((int(rows["tick"][-1]) for rows in recording.cycles.values()), default=-1)


def _task_outcome(recording: Recording, layout: Layout) -> Report | None:
    """Return what the level that knows the whole task said last."""
    mailbox = next((m.name for m in layout.mailboxes if m.message == TASK_STATUS), None)
    if mailbox is None or mailbox not in recording.mailboxes:
        return None

    def last(field: str) -> Any:
        return recording.signal(mailbox, field)[-1]

    counts = {name: int(last(name)) for name in ("action", "actions", "moves_done", "moves", "error")}
    return {"state": State(int(last("state"))).name.lower(), "reason": str(last("reason")), **counts}
