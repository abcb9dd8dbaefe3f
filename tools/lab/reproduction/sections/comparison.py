"""Section 4.1 of the paper: the systems with which it compares its model."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial

from rack.boards.config import load, wire
from rack.levels.timing.trace_times import Distribution
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.systems import (
    SYSTEMS,
    SystemFigures,
    SystemPrediction,
    prediction,
    systems,
)
from rack.tools.lab.reproduction.experiments.tasks import TASKS, TaskRun
from rack.tools.lab.reproduction.sections.page import (
    DONE,
    STRAY,
    Chapter,
    ClaimVerdict,
    Columns,
    Requirement,
    Row,
    Side,
    Statement,
    code,
    ruled,
    text,
)

RCCL = "rccl"


@cache
def _promises() -> dict[str, SystemPrediction]:
    return {name: prediction(load(name)) for name in systems()}


def _promised(workshop: Workshop) -> Side:
    rows = [_promise_row(name, said) for name, said in _promises().items()]
    head = (
        "rack",
        "levels",
        "rates, Hz",
        "boards",
        "hosts",
        "R<sub>max</sub>",
        "n R<sub>max</sub>",
        "sum",
        "command",
        "status",
        "fits",
    )
    caption = (
        "Responses by equations 3.2 and 3.3, and on the clock's grid, ms. Hosts are boards without"
        " real time."
    )
    return [Columns(head, rows, caption)]


def _promise_row(name: str, said: SystemPrediction) -> Row:
    times_ms = (said.longest_cycle_ms, said.bound_ms, said.sum_ms, said.command_ms, said.status_ms)
    times = [f"{time_ms:g}" for time_ms in times_ms]
    if not said.levels:
        times = ["-"] * len(times)
    return (
        code(name),
        text(" → ".join(said.levels)) or "-",
        ", ".join(f"{rate:.4g}" for rate in said.rates_hz) or "-",
        said.boards,
        said.hosts,
        *times,
        said.fits,
    )


def _compared_measured(workshop: Workshop, *each: SystemFigures | TaskRun) -> Side:
    found = [run for run in each if isinstance(run, SystemFigures)]
    tasks = [run for run in each if isinstance(run, TaskRun)]
    head = (
        "rack",
        "command down",
        "status up",
        "hold by an operator, longest",
        "missed, %",
    )
    rows = [_measured_row(figures) for figures in found]
    caption = (
        "Responses in ms: longest of a run in real time. A hold is given to the highest level that"
        " takes one."
    )
    failures = [f"{code(one.rack)}: {text(one.failure)}." for one in found if one.failure]
    ended = [
        (code(name), text(run.ended), f"{run.lasted_s:.1f}", f"{100 * run.missed:.2f}")
        for name, run in zip(TASKS, tasks, strict=True)
    ]
    task_head = ("rack", "end of its whole task", "after, s", "missed, %")
    return [
        Columns(head, rows, caption),
        Columns(task_head, ended, "In real time."),
        *failures,
    ]


def judge_systems(*each: SystemFigures | TaskRun) -> ClaimVerdict:
    """Compare the responses of all systems with their bounds; a missed cycle may prolong them.

    Their whole tasks are done in real time.
    """
    found = [run for run in each if isinstance(run, SystemFigures)]
    undone = sum(isinstance(run, TaskRun) and run.ended != DONE for run in each)
    failed = sum(not one.worked for one in found)
    late = [one.realtime.missed for one in found if _is_beyond(one)]
    worked = (
        Requirement("whole tasks not done", undone, "=", 0),
        Requirement("systems that failed in a run", failed, "=", 0),
    )
    return ruled(
        (*worked, Requirement("systems with a response beyond its bound", len(late), "=", 0)),
        f"All {len(found)} systems do their tasks on one set of mechanisms, within their bounds.",
        here=(*worked, Requirement("of these without a missed cycle", late.count(0.0), "=", 0)),
    )


def _measured_row(figures: SystemFigures) -> Row:
    ran = figures.realtime
    hold = ran.hold
    held = None
    if hold and hold.measured_ms is not None:
        held = f"{hold.measured_ms:g} of {hold.longest_ms:g} ({hold.level})"
    return (
        code(figures.rack),
        _longest(ran.command_ms),
        _longest(ran.status_ms),
        held,
        f"{100 * ran.missed:.2f}",
    )


def _longest(times: Distribution | None) -> str | None:
    return None if times is None else f"{times['max']:g}"


def _is_beyond(one: SystemFigures) -> bool:
    """Return whether a response of the run was longer than predicted."""
    ran = one.realtime
    said = one.predicted
    pairs = ((ran.command_ms, said.command_ms), (ran.status_ms, said.status_ms))
    if any(times is not None and times["max"] > bound + 1e-6 for times, bound in pairs):
        return True
    return ran.hold is not None and ran.hold.beyond


def judge_layers(promised: Mapping[str, SystemPrediction]) -> ClaimVerdict:
    """Count levels, and compare their rates with those of the levels below."""
    least = min(len(said.levels) for said in promised.values())
    inverted = sum(sorted(said.rates_hz) != list(said.rates_hz) for said in promised.values())
    return ruled(
        (
            Requirement("levels, in the system with the fewest", least, ">=", 2),
            Requirement("systems with a faster level above a slower one", inverted, "=", 0),
        ),
        f"From the configs alone, for all {len(promised)} systems.",
    )


SERVICES = "host-services"
LINKS: dict[str, dict[str, int]] = {
    RCCL: {
        "planning.plan": 1,
        "trajectory.command": 50,
        **{f"joint{number}.command": 1000 for number in range(1, 7)},
    },
    "chimera": {"command.requests": 1, "bridge.requests": 1},
    "condor": {"workstation.plan": 1, "adapter.plan": 1},
    "penn": {"coordinator.requests": 1, "bridge.requests": 1},
    # Rates of the general machine; of the servo rack, which begins later, and of the network four
    # messages of five.
    "brown": {
        "planning.plan": 1,
        "trajectory.command": 50,
        "lan.reference": 40,
        "lan.joints": 40,
        "supervisor.command": 400,
    },
    "ibm": {"bridge.requests": 1, "bridge.sensors": 50, "bridge.motion": 200},
    SERVICES: {"workstation.plan": 1, "adapter.hand": 50, "adapter.world": 50},
    "hic": {"tendon.command": 500, "joint.command": 500, "fingertip.command": 125},
}
"""What joins the two sides of a system, or its layers: messages by mailbox, at least so many; for
more than one, a second."""


def judge_own(name: str, found: TaskRun) -> ClaimVerdict:
    """Compare what passed between the sides of a system with what its rates demand; of RCCL also
    the processors with its joints."""
    links = []
    for box, rate_hz in LINKS[name].items():
        messages = found.messages.get(box, 0)
        if rate_hz > 1:
            per_s = messages / found.lasted_s
            links.append(Requirement(f"{box}, a second", per_s, ">=", (1.0 - STRAY) * rate_hz))
        else:
            links.append(Requirement(f"{box}, messages", messages, ">=", 1))
    worked = (
        Requirement("whole tasks done", int(found.ended == DONE), "=", 1),
        *links,
        Requirement("part of all cycles missed", found.missed, "<=", STRAY),
    )
    why = "Both sides worked together until the task was done."
    if name != RCCL:
        return ruled(worked, why)
    joints = [task.core for task in wire(load(RCCL)).tasks if task.board.startswith("joint")]
    cores = Requirement("processors, of one a joint", len(set(joints)), ">=", len(joints))
    return ruled((*worked, cores), why, here=worked)


HOSTS = Statement(SERVICES, (TASKS["condor"],), partial(judge_own, SERVICES))
CHAPTER = Chapter(
    "4.1",
    (
        Statement(
            "systems", (*SYSTEMS, *TASKS.values()), judge_systems, _promised, _compared_measured
        ),
        Statement("two-levels", (), lambda: judge_layers(_promises()), _promised),
        *(Statement(name, (TASKS[name],), partial(judge_own, name)) for name in TASKS),
    ),
)
