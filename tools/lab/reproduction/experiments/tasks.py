"""Whole tasks of the paper's systems in real time.

Each system is one rack, except Brown's, which consists of two racks joined by a network.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np

from rack.boards.config import CONFIGS, RackConfig, load, load_text
from rack.tools.console.answer import Failure
from rack.tools.lab.benches.observed import UNVIEWED_SETTINGS, count_cycles
from rack.tools.lab.reproduction.experiments.experiment import RUNS_FOLDER, Experiment, Workshop
from rack.tools.lab.reproduction.experiments.mechanisms import measure_levels, measure_mechanism
from rack.tools.launch.launch import RunResult
from rack.tools.monitor.host_side import list_entries
from rack.tools.recording.history import list_fired_rows
from rack.tools.recording.recording import Recording
from rack.tools.timing.joined_runs import measure_joined_runs
from rack.tools.timing.measured_response import measure_system_response

TASKS_S = {
    "brown/one-machine": 8.3,
    "chimera": 31.9,
    "condor": 14.3,
    "hic": 14.2,
    "ibm": 28.1,
    "penn": 26.2,
    "rccl": 17.5,
}
"""Systems of one rack with the simulated times of their tasks, s.

NASREM and the state tables have separate experiments.
"""
STATE_TABLES = "nist-state-table"
UNDISTURBED_SETTINGS = ("scene.motion=[]", "clock.mode=lockstep")
"""Settings with which only the arm moves in the cell.

In lockstep, the rows that fire then depend on no clock.
"""
TABLES_S = 55.0
SMALL_S = 3.0
BROWN = "brown"
SERVO = "brown/servo"
BROWN_S = 8.3
MAX_ATTEMPTS = 3
LAUNCH_S = 3.0
EXTRA_DELAY_MS = 100
"""Additional delay of messages from the machine above in the second run, ms."""
DELAYED_MAILBOXES = ("lan.reference", "lan.modifications")
MODIFICATION = "pd"
"""The first modification of the task."""


@dataclass(frozen=True)
class WayResponse:
    """Response in one direction, ms of simulated time.

    Attributes:
        longest_ms: Longest measured response. None if no response was measured.
        bound_ms: Longest response on the grid.
        unexplained: Number of responses beyond the bound that no missed cycle delayed.
    """

    longest_ms: float | None
    bound_ms: float
    unexplained: int


@dataclass(frozen=True)
class SystemResponse:
    """Response of a rack in each direction, and the sum of equation 3.3, ms.

    The directions are "command" and "status".
    """

    sum_eq_3_3_ms: float
    ways: dict[str, WayResponse]


def parse_response(report: Mapping[str, Any] | None) -> SystemResponse | None:
    """Return the response in a report.

    None without a hierarchy, or if it crosses racks whose timing the run does not know.
    """
    if report is None or report["crosses_racks"]:
        return None
    ways = {
        way: _parse_direction(report[way])
        for way in ("command", "status")
        # A direction that ends in another rack is measured there.
        if report[way]["bound_ms"] is not None
    }
    return SystemResponse(report["sum_eq_3_3_ms"], ways)


def _parse_direction(direction: Mapping[str, Any]) -> WayResponse:
    """Return the response in one direction from its entry in a report."""
    delays = [(*beyond["delayed_by"], *beyond["network"]) for beyond in direction["beyond"]]
    times = direction["measured_ms"]
    return WayResponse(
        longest_ms=None if times is None else times["max"],
        bound_ms=direction["bound_ms"],
        unexplained=sum(not any("missed" in delay for delay in each) for each in delays),
    )


@dataclass(frozen=True)
class TaskRun:
    """A run of a system's whole task.

    Attributes:
        ended: Reason for its end.
        lasted_s: Simulated time, s.
        missed: Fraction of all cycles that were missed or skipped.
        messages: Dictionary from mailboxes to numbers of messages.
        response: Response of the system. None if it has no bounded response.
        levels: Numbers of cycles of its levels, from the highest down, see `measure_levels`.
        mechanism: Measurements of what the paper says about this system, by name and unit.
    """

    ended: str
    lasted_s: float
    missed: float
    messages: dict[str, int]
    response: SystemResponse | None
    levels: tuple[int, ...] = field(default=(), kw_only=True)
    mechanism: dict[str, float] = field(default_factory=dict, kw_only=True)


@dataclass(frozen=True)
class NetworkRun(TaskRun):
    """A run of a task on two racks. The machine above ends it, and fails if the servo rack fails.

    Attributes:
        servo_missed: Fraction of the servo rack's cycles that were missed or skipped.
        response_ms: Median response of a command of the machine above, ms. None if it sent none.
    """

    servo_missed: float
    response_ms: float | None


def _measure_task(name: str, workshop: Workshop) -> TaskRun:
    """Run the whole task of a system in real time."""
    label = f"task-{name.replace('/', '-')}"
    run = workshop.run(label, workshop.load_config(name))
    return replace(summarize_task(*run), mechanism=measure_mechanism(name, run.recording))


def summarize_task(result: RunResult, *recordings: Recording) -> TaskRun:
    """Summarise a run of a whole task from the recordings of its racks."""
    boxes = {box: each.read_signal(box, "serial") for each in recordings for box in each.mailboxes}
    messages = {box: len(np.unique(serials)) for box, serials in boxes.items()}
    first = recordings[0]
    for status, entry, source in list_entries(first.layout, first.config):
        if source not in messages and status in first.mailboxes:
            # Count the messages of a host board where they enter the rack.
            messages[source] = int(first.read_signal(status, f"{entry}.passed")[-1])
    return TaskRun(
        ended=result.outcome.cause,
        lasted_s=result.outcome.ticks * first.layout.clock_ns * 1e-9,
        missed=_compute_missed_share(*recordings),
        messages=messages,
        response=parse_response(measure_system_response(first)),
        levels=max(map(measure_levels, recordings), key=len),
    )


@dataclass(frozen=True)
class TableRun(TaskRun):
    """A run of the task with the rows of state tables that fired, as "level: row"."""

    rows: tuple[str, ...]


@dataclass(frozen=True)
class TableRuns:
    """Runs of NIST's controller before NASREM, whose executors follow state tables.

    Attributes:
        disturbed: Run in real time with moving objects in the cell.
        undisturbed: Run in which only the arm moves.
    """

    disturbed: TableRun
    undisturbed: TableRun


def _measure_tables(workshop: Workshop) -> TableRuns:
    """Run the task of the state tables with and without a disturbance."""
    calm = f"{STATE_TABLES}-undisturbed"
    return TableRuns(
        _run_tables(workshop, STATE_TABLES), _run_tables(workshop, calm, UNDISTURBED_SETTINGS)
    )


def _run_tables(workshop: Workshop, label: str, settings: Sequence[str] = ()) -> TableRun:
    """Run the task of the state tables, and list the rows that fired."""
    result, recording = workshop.run(label, workshop.load_config(STATE_TABLES, settings))
    fired = list_fired_rows(recording).items()
    rows = (f"{level}: {row['name']}" for level, rows in fired for row in rows)
    return TableRun(**vars(summarize_task(result, recording)), rows=tuple(rows))


TABLES = Experiment(
    STATE_TABLES,
    "state tables, with a disturbance and without",
    TABLES_S,
    TableRuns,
    _measure_tables,
)


def _measure_small_tables(workshop: Workshop) -> TaskRun:
    """Run the controller of the state tables without its task level for `SMALL_S`."""
    config = workshop.load_config(str(CONFIGS / STATE_TABLES / "direct.toml"))
    return summarize_task(*workshop.run(f"{STATE_TABLES}-small", config, SMALL_S))


SMALL_TABLES = Experiment(
    f"{STATE_TABLES}-small",
    "state tables without the task level",
    SMALL_S + LAUNCH_S,
    TaskRun,
    _measure_small_tables,
)


def _compute_missed_share(*recordings: Recording) -> float:
    """Return the fraction of all cycles of some runs that were missed or skipped."""
    return count_cycles(
        task for each in recordings for task in each.end_counts["tasks"].values()
    ).share


def _measure_two_racks(later_ms: int, workshop: Workshop) -> NetworkRun:
    """Run Brown's racks with a network that is slower by `later_ms`.

    Two recorders share two cores with eight boards and may lose records. A run with lost records is
    repeated, up to `MAX_ATTEMPTS` runs in total.
    """
    lost: list[str] = []
    for attempt in range(1, MAX_ATTEMPTS + 1):
        result, general, servo = _record_two_racks(later_ms, workshop, attempt)
        lost = [each.layout.rack for each in (general, servo) if each.lost_rows]
        if not lost:
            holding = servo.read_signal("supervisor.status", "holding")
            reasons = servo.read_signal("shoulder.status", "reason")
            # The joints hold without fresh references of the other rack.
            found = {
                "modifications_unanswered": float(
                    not any(MODIFICATION in str(text) for text in reasons)
                ),
                "references_lacking_share": holding.mean() if len(holding) else 1.0,
            }
            across = sorted(measure_joined_runs([general, servo]), key=itemgetter("bound_ms"))
            longest = {one["direction"]: one for one in across if one["count"]}
            ways = {way: _parse_direction(one) for way, one in longest.items()}
            run = summarize_task(result, general, servo)
            response = run.response and replace(run.response, ways=ways)
            return NetworkRun(
                **vars(run) | {"mechanism": found, "response": response},
                servo_missed=_compute_missed_share(servo),
                response_ms=longest["command"]["measured_ms"]["p50"] if "command" in ways else None,
            )
    raise Failure(f"{' and '.join(lost)} lost records in each of {MAX_ATTEMPTS} runs")


def _record_two_racks(
    later_ms: int, workshop: Workshop, attempt: int
) -> tuple[RunResult, Recording, Recording]:
    """Run both of Brown's racks, and return the result and both recordings."""
    label = f"task-{BROWN}-{later_ms}-{attempt}"
    path = workshop.folder / f"{label}-servo.toml"
    path.write_text(_build_servo_config(workshop, later_ms).to_toml_text(), encoding="utf-8")
    general_config = _load_renamed(workshop, BROWN, [f'adapter.lan.launch=["{path}"]'])
    with chdir(workshop.folder):
        # The rack that is launched by this one records its run below the working folder.
        result, general = workshop.run(label, general_config)
    (launched,) = result.others
    assert launched.folder is not None, "it is recorded, as the other is"
    folder = workshop.folder / RUNS_FOLDER / f"{label}-servo"
    shutil.rmtree(folder, ignore_errors=True)
    return result, general, Recording((workshop.folder / launched.folder).rename(folder))


def _build_servo_config(workshop: Workshop, later_ms: int) -> RackConfig:
    """Build the config of the servo rack, which receives messages `later_ms` later than normal."""
    settings = []
    if later_ms:
        config = load(SERVO)
        assert config.adapter.lan is not None
        cycles = round(1e-3 * later_ms * config.adapter.lan.rate_hz)
        faults = [
            f'{{kind="delay", board="lan", mailbox="{box}", by={cycles}}}'
            for box in DELAYED_MAILBOXES
        ]
        delay_s = config.board["supervisor"].params["delay"] + 1e-3 * later_ms
        settings = [f"board.supervisor.params.delay={delay_s}", f"fault=[{', '.join(faults)}]"]
    return _load_renamed(workshop, SERVO, settings)


def _load_renamed(workshop: Workshop, name: str, settings: Sequence[str]) -> RackConfig:
    """Load one of the two racks with settings, and give unique names to both in its config."""
    text = load(workshop.find_source(name), [*settings, *UNVIEWED_SETTINGS]).to_toml_text()
    return load_text(re.sub(f'(?<=["_]){BROWN}(?=["/-])|(?<=unix/){BROWN}', workshop.rack, text))


def _build_network_experiment(later_ms: int, about: str) -> Experiment[NetworkRun]:
    """Build the experiment with Brown's racks on a network that is slower by `later_ms`."""
    name = f"task-{BROWN}-later" if later_ms else f"task-{BROWN}"
    measure = partial(_measure_two_racks, later_ms)
    return Experiment(name, about, BROWN_S + 2 * LAUNCH_S, NetworkRun, measure)


NETWORK = _build_network_experiment(0, "the whole task of brown's two racks in real time")
SLOWER_NETWORK = _build_network_experiment(
    EXTRA_DELAY_MS, f"the same, with a network slower by {EXTRA_DELAY_MS} ms"
)
TASKS: dict[str, Experiment[Any]] = {
    BROWN: NETWORK,
    **{
        name: Experiment(
            f"task-{name.replace('/', '-')}",
            f"the whole task of {name} in real time",
            lasts_s + LAUNCH_S,
            TaskRun,
            partial(_measure_task, name),
        )
        for name, lasts_s in TASKS_S.items()
    },
}
