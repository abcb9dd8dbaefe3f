"""Measurements that `rack bench` makes too: context switch, pipeline, response to an operator,
partitions, and the paper's other systems, each rack by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from rack.tools.console.progress import Progress
from rack.tools.lab.benches import partition, switch
from rack.tools.lab.benches.observed import Runs
from rack.tools.lab.benches.response import ResponseBench, ResponseRuns
from rack.tools.lab.benches.systems.bench import measure, systems
from rack.tools.lab.benches.systems.motion import poses_config
from rack.tools.lab.benches.systems.tables import Systems
from rack.tools.lab.reproduction.experiments.experiment import (
    Experiment,
    Workshop,
    inputs,
    need_real_time,
)
from rack.tools.recording.history import counted, misses

COMMANDS = 16
TWINS = 1
SEED = 1
PARTITION_S = 12.0
"""By half of it every level has planned in lockstep; on one processor it takes longer."""
SYSTEM_S = 4.0
SYSTEM_LASTS_S = 15.0
POSES_LAST_S = 19.0
"""About how long a rack takes, and how much longer one with a PUMA."""
TASKS_S = {
    "rccl": 17.5,
    "hic": 14.2,
    "condor": 14.3,
    "ibm": 28.1,
    "chimera": 31.9,
    "penn": 26.2,
    "brown": 8.2,
}
"""The systems, with the simulated time of their tasks; experiments of their own run the tasks of
NASREM and of the state tables."""
ONE_RACK = {"brown": "brown/one-machine"}
"""The config in which a system is one rack, where its main one needs another rack."""
LAUNCH_S = 3.0
NAME = "nasrem"


@dataclass(frozen=True)
class SwitchRun:
    """The context switch of this machine, and the one that the config assumes, us."""

    cost: switch.SwitchCost
    assumed_us: float


def _switch(workshop: Workshop) -> SwitchRun:
    need_real_time(cores=2)
    assumed_us = 1e3 * workshop.config(NAME).timing.context_switch_ms
    return SwitchRun(switch.measure(), assumed_us)


SWITCH = Experiment(
    "switch",
    "the context switch",
    switch.WAKES * switch.PERIOD_S + LAUNCH_S,
    SwitchRun,
    inputs(NAME, wakes=switch.WAKES),
    _switch,
)


@dataclass(frozen=True)
class ResponseRun:
    """Commands of an operator in lockstep, with twins that show which torque rests on one, and in
    real time."""

    lockstep: ResponseBench
    realtime: ResponseBench


def _response(workshop: Workshop) -> ResponseRun:
    need_real_time()
    lockstep, realtime = (
        ResponseRuns(workshop.source(NAME), mode, SEED, Progress()).measure(COMMANDS, twins)
        for mode, twins in (("lockstep", TWINS), ("realtime", 0))
    )
    return ResponseRun(lockstep, realtime)


RESPONSE = Experiment(
    "response",
    "holds and resumes by an operator",
    80.0,
    ResponseRun,
    inputs(NAME, commands=COMMANDS, twins=TWINS, seed=SEED),
    _response,
)


def _partition(workshop: Workshop) -> partition.Partitions:
    need_real_time(cores=2)
    return partition.measure(workshop.source(NAME), PARTITION_S, 1, Progress())


PARTITION = Experiment(
    "partition",
    "nasrem with its planners on one core and on two",
    len(partition.PARTITIONS) * (PARTITION_S + LAUNCH_S),
    partition.Partitions,
    inputs(NAME, seconds=PARTITION_S),
    _partition,
)


def system_experiment(name: str) -> Experiment[Systems]:
    """Return the figures of one rack, in lockstep and in real time."""
    return Experiment(
        f"system-{name.replace('/', '-')}",
        f"{name} next to the other systems",
        SYSTEM_LASTS_S + POSES_LAST_S * (poses_config(name) is not None),
        Systems,
        inputs(name, seconds=SYSTEM_S),
        partial(_system, name),
    )


def _system(name: str, workshop: Workshop) -> Systems:
    return measure([workshop.source(name)], Runs(SYSTEM_S, 1, workshop.share), Progress())


def compared(each: Sequence[Systems]) -> Systems:
    """Return what was measured of several racks, as one comparison."""
    return Systems(
        tuple(figures for one in each for figures in one.systems), SYSTEM_S, each[0].absent
    )


SYSTEMS = tuple(system_experiment(name) for name in systems())
"""Every rack that models a system, NASREM first."""


@dataclass(frozen=True)
class TaskRun:
    """A system's whole task in real time: how it ended, the part of all cycles missed or skipped,
    and the messages in each mailbox."""

    ended: str
    lasted_s: float
    missed: float
    messages: dict[str, int]


def _task(name: str, workshop: Workshop) -> TaskRun:
    need_real_time()
    result, recording = workshop.run(f"task-{name}", workshop.config(ONE_RACK.get(name, name)))
    cycles = sum(map(len, recording.cycles.values()))
    boxes = {box: recording.signal(box, "serial") for box in recording.mailboxes}
    return TaskRun(
        ended=result.outcome.cause,
        lasted_s=result.outcome.ticks * recording.layout.clock_ns * 1e-9,
        missed=sum(counted(misses(recording))) / cycles,
        messages={box: len(np.unique(serials)) for box, serials in boxes.items()},
    )


TASKS = {
    name: Experiment(
        f"task-{name}",
        f"the whole task of {name} in real time",
        lasts_s + LAUNCH_S,
        TaskRun,
        inputs(ONE_RACK.get(name, name)),
        partial(_task, name),
    )
    for name, lasts_s in TASKS_S.items()
}
