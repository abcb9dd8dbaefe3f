"""Whole tasks of the paper's systems in real time: each is one rack, but Brown's, which is two
joined by a network.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from rack.boards.config import RackConfig, load
from rack.tools.console.answer import Failure
from rack.tools.lab.benches.observed import UNVIEWED, count_cycles
from rack.tools.lab.reproduction.experiments.experiment import RUNS, Experiment, Workshop
from rack.tools.launch.launch import RunResult
from rack.tools.monitor.host_side import entries_of
from rack.tools.recording.history import fired_rows
from rack.tools.recording.recording import Recording
from rack.tools.recording.time_line import RackGrid
from rack.tools.timing.measured_response import system_response

TASKS_S = {
    "brown/one-machine": 8.3,
    "chimera": 31.9,
    "condor": 14.3,
    "hic": 14.2,
    "ibm": 28.1,
    "penn": 26.2,
    "rccl": 17.5,
}
"""The systems of one rack, with the simulated time of their tasks, s; NASREM and the state tables
have experiments of their own."""
STATE_TABLES = "nist-state-table"
UNDISTURBED = ("scene.motion=[]", "clock.mode=lockstep")
"""Nothing in the cell moves but the arm; which rows fire then depends on no clock."""
TABLES_S = 55.0
BROWN = "brown"
SERVO = "brown/servo"
BROWN_S = 8.3
PATIENCE = 2.0
"""Multiple of its time after which a task is ended, because a machine that is too slow may never
finish it."""
ATTEMPTS = 3
LAUNCH_S = 3.0
LATER_MS = 100
"""Additional delay of messages from the machine above in the second run."""
DELAYED = ("lan.reference", "lan.modifications")
MODIFICATION = "pd"
"""The first modification of the task."""


@dataclass(frozen=True)
class WayResponse:
    """The response one way, ms of simulated time.

    Attributes:
        longest_ms: The longest that was measured; None if nothing went all the way.
        bound_ms: The longest on the grid.
        unexplained: Responses beyond the bound that no missed cycle delayed.
    """

    longest_ms: float | None
    bound_ms: float
    unexplained: int


@dataclass(frozen=True)
class SystemResponse:
    """The response of a rack by way, "command" and "status", next to equation 3.3, ms."""

    sum_eq_3_3_ms: float
    ways: dict[str, WayResponse]


def response_from(found: Mapping[str, Any] | None) -> SystemResponse | None:
    """Return the response in a report; None without a hierarchy, or if it crosses racks, for which
    there is no bound.
    """
    if found is None or found["crosses_racks"]:
        return None
    ways = {way: _way_response(found[way]) for way in ("command", "status")}
    return SystemResponse(found["sum_eq_3_3_ms"], ways)


def _way_response(way: Mapping[str, Any]) -> WayResponse:
    delays = [beyond["delayed_by"] for beyond in way["beyond"]]
    times = way["measured_ms"]
    return WayResponse(
        longest_ms=None if times is None else times["max"],
        bound_ms=way["bound_ms"],
        unexplained=sum(not any("missed" in delay for delay in each) for each in delays),
    )


@dataclass(frozen=True)
class TaskRun:
    """A run of a system's whole task.

    Attributes:
        ended: Cause of its end.
        lasted_s: Simulated time.
        missed: Share of all cycles missed or skipped.
        messages: Number of messages by mailbox.
        response: The response of the system. None if it has no bounded response.
    """

    ended: str
    lasted_s: float
    missed: float
    messages: dict[str, int]
    response: SystemResponse | None


@dataclass(frozen=True)
class NetworkRun(TaskRun):
    """A run of a task on two racks, ended by the machine above, which fails if the servo rack does.

    Attributes:
        servo_missed: Share of the servo rack's cycles missed or skipped.
        response_ms: Time from the request of a modification by the machine above until a servo law
            is modified. None if it never was.
    """

    servo_missed: float
    response_ms: float | None


def _measure(name: str, workshop: Workshop) -> TaskRun:
    label = f"task-{name.replace('/', '-')}"
    return task_run(*workshop.run(label, workshop.config(name), PATIENCE * TASKS_S[name]))


def task_run(result: RunResult, *recordings: Recording) -> TaskRun:
    """Return what a whole task has left, in the recordings of its racks."""
    boxes = {box: one.signal(box, "serial") for one in recordings for box in one.mailboxes}
    messages = {box: len(np.unique(serials)) for box, serials in boxes.items()}
    first = recordings[0]
    for status, entry, source in entries_of(first.layout, first.config):
        if source not in messages and status in first.mailboxes:
            # Messages of a host board are counted where they enter the rack.
            messages[source] = int(first.signal(status, f"{entry}.passed")[-1])
    return TaskRun(
        ended=result.outcome.cause,
        lasted_s=result.outcome.ticks * first.layout.clock_ns * 1e-9,
        missed=_missed(*recordings),
        messages=messages,
        response=response_from(system_response(first)),
    )


@dataclass(frozen=True)
class TableRun(TaskRun):
    """A run of the task with the rows of state tables that fired, as "level: row"."""

    rows: tuple[str, ...]


@dataclass(frozen=True)
class TableRuns:
    """NIST's controller before NASREM, of executors with state tables: with what moves in the cell,
    in real time, and without.
    """

    disturbed: TableRun
    undisturbed: TableRun


def _measure_tables(workshop: Workshop) -> TableRuns:
    calm = f"{STATE_TABLES}-undisturbed"
    return TableRuns(_table_run(workshop, STATE_TABLES), _table_run(workshop, calm, UNDISTURBED))


def _table_run(workshop: Workshop, label: str, settings: Sequence[str] = ()) -> TableRun:
    result, recording = workshop.run(label, workshop.config(STATE_TABLES, settings))
    fired = fired_rows(recording).items()
    rows = (f"{level}: {row['name']}" for level, rows in fired for row in rows)
    return TableRun(**vars(task_run(result, recording)), rows=tuple(rows))


TABLES = Experiment(
    STATE_TABLES,
    "state tables, with a disturbance and without",
    TABLES_S,
    TableRuns,
    _measure_tables,
)


def _missed(*recordings: Recording) -> float:
    return count_cycles(task for one in recordings for task in one.ended["tasks"].values()).share


def _measure_two(later_ms: int, workshop: Workshop) -> NetworkRun:
    """Run Brown's racks with a network that is slower by `later_ms`.

    Two recorders share two cores with eight boards, so a run may lose records. It is then repeated,
    up to `ATTEMPTS` runs in all.
    """
    lost: list[str] = []
    for attempt in range(1, ATTEMPTS + 1):
        result, general, servo = _two_recorded(later_ms, workshop, attempt)
        lost = [one.layout.rack for one in (general, servo) if one.lost]
        if not lost:
            return NetworkRun(
                **vars(task_run(result, general, servo)),
                servo_missed=_missed(servo),
                response_ms=_response_ms(general, servo),
            )
    raise Failure(f"not all of {' and '.join(lost)} is recorded, in {ATTEMPTS} runs")


def _two_recorded(
    later_ms: int, workshop: Workshop, attempt: int
) -> tuple[RunResult, Recording, Recording]:
    label = f"task-{BROWN}-{later_ms}-{attempt}"
    path = workshop.folder / f"{label}-servo.toml"
    path.write_text(_servo(workshop, later_ms).text(), encoding="utf-8")
    ways = f'adapter.lan.connect=["{_socket(workshop)}"]', f'adapter.lan.launch=["{path}"]'
    with chdir(workshop.folder):
        # The rack that it launches records its run below the working folder.
        result, general = workshop.run(label, _renamed(workshop, BROWN, ways))
    (other,) = result.others
    assert other.folder is not None, "it is recorded, as the other is"
    folder = workshop.folder / RUNS / f"{label}-servo"
    shutil.rmtree(folder, ignore_errors=True)
    return result, general, Recording((workshop.folder / other.folder).rename(folder))


def _servo(workshop: Workshop, later_ms: int) -> RackConfig:
    peer = f"lan.peer_{workshop.rack.replace('-', '_')}"
    more = [f'adapter.lan.listen=["{_socket(workshop)}"]', f'board.supervisor.reads.peer="{peer}"']
    if later_ms:
        given = load(SERVO)
        assert given.adapter.lan is not None
        by = round(1e-3 * later_ms * given.adapter.lan.rate_hz)
        faults = [f'{{kind="delay", board="lan", mailbox="{box}", by={by}}}' for box in DELAYED]
        delay = given.board["supervisor"].params["delay"] + 1e-3 * later_ms
        more += [f"board.supervisor.params.delay={delay}", f"fault=[{', '.join(faults)}]"]
    return _renamed(workshop, SERVO, more)


def _socket(workshop: Workshop) -> str:
    return f"unix/{workshop.rack}-servo"


def _renamed(workshop: Workshop, name: str, more: Sequence[str]) -> RackConfig:
    """Return one of both racks under a unique name, which the other rack uses for its imports."""
    given = load(name)
    assert given.adapter.lan is not None
    own = {BROWN: workshop.rack, f"{BROWN}-servo": f"{workshop.rack}-servo"}
    imports = [
        f'adapter.lan.import.{port}.from="{own[entry.rack]}/{entry.mailbox}"'
        for port, entry in given.adapter.lan.imports.items()
    ]
    return load(workshop.source(name), [*imports, *more, *UNVIEWED, f"name={own[given.name]}"])


def _response_ms(general: Recording, servo: Recording) -> float | None:
    """Return the time from the first message that wants a modification to the status that says it
    is in.
    """
    wanted_ns = _first_ns(general, "modifications.command", "wanted")
    is_in_ns = _first_ns(servo, "shoulder.status", "reason")
    return None if wanted_ns is None or is_in_ns is None else 1e-6 * (is_in_ns - wanted_ns)


def _first_ns(recording: Recording, box: str, field: str) -> int | None:
    """Return when the first message that names the modification is visible: on CLOCK_MONOTONIC, in
    lockstep in the simulated time of both.
    """
    named = [MODIFICATION in str(text) for text in recording.signal(box, field)]
    ticks = recording.signal(box, "visible_at")[named]
    if not len(ticks):
        return None
    grid = RackGrid(recording)
    if grid.is_lockstep:
        return int(ticks[0]) * grid.clock_ns
    return int(grid.stamp_ns(ticks[:1])[0])


def _two_racks(later_ms: int, about: str) -> Experiment[NetworkRun]:
    name = f"task-{BROWN}-later" if later_ms else f"task-{BROWN}"
    lasts_s = BROWN_S + 2 * LAUNCH_S
    return Experiment(name, about, lasts_s, NetworkRun, partial(_measure_two, later_ms))


NETWORK = _two_racks(0, "the whole task of brown's two racks in real time")
LATER = _two_racks(LATER_MS, f"the same, with a network slower by {LATER_MS} ms")
TASKS: dict[str, Experiment[Any]] = {
    BROWN: NETWORK,
    **{
        name: Experiment(
            f"task-{name.replace('/', '-')}",
            f"the whole task of {name} in real time",
            lasts_s + LAUNCH_S,
            TaskRun,
            partial(_measure, name),
        )
        for name, lasts_s in TASKS_S.items()
    },
}
