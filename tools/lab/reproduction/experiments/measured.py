"""Measurements that `rack bench` makes too: context switch, pipeline, response to an operator,
partitions, and the paper's other systems, each rack by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

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
    need_real_time,
)

COMMANDS = 12
TWINS = 1
SEED = 1
PARTITION_S = 12.0
"""By half of it every level has planned in lockstep; on one processor it takes longer."""
SYSTEM_S = 4.0
SYSTEM_LASTS_S = 15.0
POSES_LAST_S = 19.0
"""About how long a rack takes, and how much longer one with a PUMA."""
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
    62.0,
    ResponseRun,
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
    _partition,
)


def system_experiment(name: str) -> Experiment[Systems]:
    """Return the figures of one rack, in lockstep and in real time."""
    return Experiment(
        f"system-{name.replace('/', '-')}",
        f"{name} next to the other systems",
        SYSTEM_LASTS_S + POSES_LAST_S * (poses_config(name) is not None),
        Systems,
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
