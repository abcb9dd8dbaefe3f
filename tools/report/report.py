"""Collects the report of a run, report.json and report.md."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from rack.backplane.layout import Layout, TaskSpec
from rack.backplane.standby import find_original
from rack.boards.config import RackConfig, resolve_layout
from rack.boards.exchange import AGE_SUFFIX, EXCHANGE_PORT
from rack.boards.timing.trace_times import (
    compute_distribution,
    compute_plan_ages,
    count_misses_and_skips,
)
from rack.levels.peer import Presence, format_peer_port
from rack.tools.console.answer import Document, write_file, write_json
from rack.tools.faults.judge import report_faults
from rack.tools.launch.verdict import UNRECORDED, build_verdict
from rack.tools.monitor.host_side import ENTRY_COUNTS, list_entries
from rack.tools.monitor.interrupts import summarize_interrupts
from rack.tools.monitor.network import ADAPTER, COUNTS, STATUS, read_entries
from rack.tools.monitor.queues import summarize_queues
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.folder_size import measure_sizes
from rack.tools.recording.history import (
    list_fired_rows,
    list_holds,
    list_misses,
    summarize_gaps,
    summarize_steal,
)
from rack.tools.recording.origin import Origin
from rack.tools.recording.recording import Recording
from rack.tools.recording.stalls import analyze_stalls
from rack.tools.report import arm_outcome
from rack.tools.report.miss_causes import add_causes
from rack.tools.report.report_markdown import format_markdown
from rack.tools.report.run_report import RunReport
from rack.tools.report.summary import format_run_summary
from rack.tools.report.task_times import compute_task_times
from rack.tools.timing.measured_response import measure_system_response

COMPARISON = "rack.tools.report.against"
"""Module that compares two runs.

It is given by name, because it imports code that a report on one run does not need.
"""


@dataclass(frozen=True)
class OtherRun:
    """Another run to compare the reported run with, and options of the comparison.

    Attributes:
        folder: Folder of the other run.
        mailbox: Mailbox whose first difference is explained, or "" for the earliest difference.
        may_repeat: Whether both runs may be repeated to find the cause.
    """

    folder: Path
    mailbox: str
    may_repeat: bool


def write_report(folder: Path, against: OtherRun | None = None) -> tuple[Document, str]:
    """Write report.json and report.md into the folder of a run.

    Args:
        folder: Folder of the run.
        against: A run to compare with. The report then says where and why the two runs diverge.

    Returns:
        The report as data and as text.
    """
    recording = Recording(folder)
    report = build_report(recording)
    report |= measure_sizes(folder, report["simulated_s"])
    if against is not None:
        report["against"] = import_module(COMPARISON).compare_runs(recording, against)
    report["summary"] = format_run_summary(report)
    text = format_markdown(report)
    write_json(folder / "report.json", report)
    write_file(folder / "report.md", text)
    Checksums(folder).store("report.*")
    return report, text


def build_report(recording: Recording) -> Document:
    """Return the report of a recorded run as plain data."""
    config = recording.rack_config
    layout = recording.layout
    ended = recording.end_counts
    recording.register_fault_kinds()
    origin = Origin.read_from(recording)
    missed_cycles = list_misses(recording)
    last_tick = max((int(rows["tick"][-1]) for rows in recording.cycles.values()), default=-1)
    stalls, absent = analyze_stalls(recording)
    response = measure_system_response(recording)
    tasks = {task.name: _build_task_entry(recording, config, task) for task in layout.tasks}
    return replace(
        _build_head(config, ended, tasks, last_tick + 1, response),
        folder=str(recording.folder),
        continues=None if origin is None else origin.to_document(layout.clock_ns),
        misses=list(add_causes(recording, missed_cycles, absent)),
        steal=summarize_steal(recording),
        stalls=asdict(stalls),
        notes=[event["text"] for event in recording.events if event["kind"] == "ready"],
        holds=list_holds(recording),
        state_tables=list_fired_rows(recording),
        **report_faults(recording.events, layout),
        standbys=summarize_standbys(recording),
        system_response=response,
        data_ages=list(summarize_data_ages(recording)),
        entries=list(_summarize_entries(recording)),
        network=summarize_network(recording),
        task=arm_outcome.summarize_task(recording),
        objects=list(arm_outcome.summarize_objects(recording, config)),
        motion=arm_outcome.summarize_motion(recording),
        hand=arm_outcome.summarize_hand(recording, config),
        force=arm_outcome.summarize_force(recording),
        queues=list(summarize_queues(recording)),
        interrupts=list(summarize_interrupts(recording)),
        recording=ended.get("recording", "without the end of the run"),
        **summarize_gaps(recording),
    ).to_document()


def summarize_standbys(recording: Recording) -> list[Document]:
    """Return the active copy of each task with standbys at the end, since when, and why."""
    since: Document = {"since_tick": 0, "since_s": 0.0, "why": "", "hand_overs": 0}
    layout = recording.layout
    found = {task: {"task": task, "active": task, **since} for task in layout.replicated_tasks}
    # A run that continues another one also has hand-overs of that one.
    for event in (*recording.end_counts.get("earlier", ()), *recording.events):
        if event.get("code") == "taken_over":
            copy = event["subject"]
            task = find_original(layout, copy)
            found[task] = {
                "task": task,
                "active": copy,
                "since_tick": event["tick"],
                "since_s": event["tick"] * layout.clock_ns * 1e-9,
                "why": event["text"].partition(": ")[2],
                "hand_overs": found.get(task, since)["hand_overs"] + 1,
            }
    return [*found.values()]


def build_unrecorded_report(config: RackConfig, ended: Mapping[str, Any]) -> Document:
    """Return the report of a run that was not recorded.

    It has the same keys as other reports. The values of keys that need a recording are null.

    Args:
        config: Config of the run.
        ended: Counts at the end of the run.
    """
    layout = resolve_layout(config)
    tasks = {
        task.name: {**_describe_task(task, layout), **ended["tasks"][task.name]}
        for task in layout.tasks
    }
    head = _build_head(config, ended, tasks, 0, None)
    unjudged = [*head.unjudged, UNRECORDED]
    return replace(head, unjudged=unjudged, recording=ended["recording"]).to_document()


def _build_head(
    config: RackConfig,
    ended: Mapping[str, Any],
    tasks: Mapping[str, Document],
    ticks: int,
    response: Document | None,
) -> RunReport:
    """Return the part of a report that needs no recording.

    Args:
        config: Config of the run.
        ended: Counts at the end of the run. Empty if the end was not recorded.
        tasks: Entries of the tasks.
        ticks: Length of the run in ticks, which is used if the end was not recorded.
        response: Measured response of the system, or None.
    """
    outcome = ended.get("outcome", {})
    return RunReport(
        rack=config.name,
        mode=config.clock.mode,
        lockstep_load=config.simulated_load,
        speed=config.clock.speed,
        clock_ms=config.clock.period_ms,
        **build_verdict(ended, response),
        outcome=outcome or None,
        digest=outcome.get("digest"),
        objects=outcome.get("objects", []),
        simulated_s=round(outcome.get("ticks", ticks) * config.clock_ns * 1e-9, 6),
        wall_s=round(ended.get("wall_s", 0.0), 6),
        clock_skipped=ended.get("clock_skipped", 0),
        others=list(ended.get("others", ())),
        tasks=tasks,
        missed=sum(task["missed"] for task in tasks.values()),
        skipped=sum(task["skipped"] for task in tasks.values()),
    )


def _build_task_entry(recording: Recording, config: RackConfig, task: TaskSpec) -> Document:
    """Return the entry of a task in the report: role, slot, rate, counts and times."""
    layout = recording.layout
    cycles = recording.read_trace(task.name)
    missed, skipped = count_misses_and_skips(cycles)
    # If the end of the run was not recorded, the trace has the only counts.
    counts = recording.find_task_counts(task.name) or {"missed": missed, "skipped": skipped}
    stretches = recording.find_stretches(cycles["tick"])
    period_ns = layout.clock_ns if config.is_lockstep else config.tick_ns
    entry = {
        **_describe_task(task, layout),
        **counts,
        **compute_task_times(
            task,
            cycles,
            period_ns,
            config.takes_time,
            stretches=stretches,
            due_ns=layout.compute_due_ticks(task) * period_ns,
        ),
    }
    if task.role == "executor" and f"{task.board}.plan" in recording.mailboxes:
        entry["plan_age_ms"] = compute_distribution(compute_plan_ages_ms(recording, task.board))
    return entry


def compute_plan_ages_ms(recording: Recording, board: str) -> np.ndarray:
    """Return the age of the visible plan in each cycle of an executor, in ms of simulated time.

    Cycles for which `compute_plan_ages` finds no visible plan are left out. Shape (n,).
    """
    plan = f"{board}.plan"
    plan_ticks = recording.read_signal(plan, "tick")
    visible_at = recording.read_signal(plan, "visible_at")
    ticks = recording.read_trace(board)["tick"]
    cycle_stretches = recording.find_stretches(ticks)
    plan_stretches = recording.find_stretches(plan_ticks)
    ages = [
        compute_plan_ages(
            ticks[cycle_stretches == stretch],
            plan_ticks[plan_stretches == stretch],
            visible_at[plan_stretches == stretch],
        )
        for stretch in np.unique(plan_stretches)
    ]
    return np.concatenate(ages) * (recording.layout.clock_ns * 1e-6)


def _describe_task(task: TaskSpec, layout: Layout) -> Document:
    """Return role, slot and rate of a task for its entry in the report."""
    return {"role": task.role, "slot": task.slot, "rate_hz": 1e9 / (task.every * layout.clock_ns)}


def _summarize_entries(recording: Recording) -> Iterator[Document]:
    """Yield counts and message ages (in ms) for every entry that a bus adapter forwards."""
    tick_ms = recording.layout.clock_ns * 1e-6
    for mailbox, entry, source in list_entries(recording.layout, recording.config):
        if mailbox in recording.mailboxes:
            ages = recording.read_signal(mailbox, f"{entry}.age")
            counts = _read_last_counts(recording, mailbox, entry, ENTRY_COUNTS)
            name = f"{mailbox.partition('.')[0]}.{entry}"
            ages_ms = compute_distribution(ages[ages >= 0] * tick_ms)
            yield {"entry": name, "source": source, **counts, "age_ms": ages_ms}


def summarize_data_ages(recording: Recording) -> Iterator[Document]:
    """Yield the ages in ms of the messages at each input of the boards with an exchange record.

    An age counts from the release of the writer's cycle to that of the cycle that takes the
    message. `jitter` is the difference of the largest and the smallest age.
    """
    for box in recording.layout.mailboxes:
        board, _, port = box.name.partition(".")
        if port != EXCHANGE_PORT:
            continue
        ticks = recording.read_signal(box.name, "tick")
        # Ages and arrivals alternate.
        for age, taken in zip(box.fields[::2], box.fields[1::2], strict=True):
            is_new = recording.read_signal(box.name, taken.name) == ticks
            ages = recording.read_signal(box.name, age.name)[is_new] * recording.layout.clock_ns
            if ages_ms := compute_distribution(ages * 1e-6):
                yield {
                    "entry": f"{board}.{age.name.removesuffix(f'_{AGE_SUFFIX}')}",
                    "taken": len(ages),
                    "jitter": ages_ms["max"] - ages_ms["min"],
                    "age_ms": ages_ms,
                }


def summarize_network(recording: Recording) -> Document | None:
    """Return the traffic with other racks, and how often contact with them was lost.

    Returns:
        Imports with counts and ages in ms, exports with counts, and the states of the other racks.
        None if the rack has no network adapter, or if none of its messages were recorded.
    """
    if STATUS not in recording.mailboxes or recording.rack_config.adapter.lan is None:
        return None
    exchange = read_entries(recording.config)
    imports = []
    for port, source in exchange.imports.items():
        ages_s = recording.read_signal(STATUS, f"import_{port}.age_s")
        counts = _read_last_counts(recording, STATUS, f"import_{port}", COUNTS)
        # The age is recorded in every cycle of the adapter, and grows until the next message
        # arrives.
        ages = compute_distribution(ages_s[ages_s >= 0.0] * 1e3)
        imports.append({"entry": f"{ADAPTER}.{port}", "source": source, **counts, "age_ms": ages})
    exports = [
        {
            "entry": f"{ADAPTER}.{port}",
            "source": source,
            **_read_last_counts(recording, STATUS, f"export_{port}", ("sent",)),
        }
        for port, source in exchange.exports.items()
    ]
    peers = [_summarize_peer(recording, rack) for rack in exchange.peers]
    return {"imports": imports, "exports": exports, "peers": peers}


def _summarize_peer(recording: Recording, rack: str) -> Document:
    """Return the final state of another rack, and number and duration of losses of contact."""
    mailbox = f"{ADAPTER}.{format_peer_port(rack)}"
    presence = recording.read_signal(mailbox, "presence")
    cycle_s = recording.layout.find_task(ADAPTER).every * recording.layout.clock_ns * 1e-9
    return {
        "peer": rack,
        "state": Presence(int(presence[-1])).name.lower(),
        "losses": int(recording.read_signal(mailbox, "losses")[-1]),
        "restarts": max(0, int(recording.read_signal(mailbox, "launches")[-1]) - 1),
        "lost_s": round(float((presence == Presence.LOST).sum() * cycle_s), 6),
    }


def _read_last_counts(
    recording: Recording, mailbox: str, group: str, names: Iterable[str]
) -> dict[str, int]:
    """Return counts of a group of fields from the last recorded message of a mailbox."""
    return {name: int(recording.read_signal(mailbox, f"{group}.{name}")[-1]) for name in names}
