"""Measurements that `rack bench` makes too: context switch, pipeline, response to an operator,
partitions, and the paper's other systems, each rack by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from rack.boards.config import loads
from rack.boards.config.schema import Mode
from rack.levels.timing.equations import response_ticks
from rack.tools.console.progress import Progress
from rack.tools.lab.benches import partition, switch
from rack.tools.lab.benches.boards import responses_of
from rack.tools.lab.benches.chain import Chain
from rack.tools.lab.benches.observed import Runs, observe
from rack.tools.lab.benches.response import ResponseBench, ResponseRuns
from rack.tools.lab.benches.systems.bench import measure, systems
from rack.tools.lab.benches.systems.tables import Systems
from rack.tools.lab.reproduction.experiments.experiment import (
    Experiment,
    Workshop,
    inputs,
    need_real_time,
)

LEVELS = 5
"""Levels of the pipeline: "it would take 5 control cycles"."""
RATE_HZ = 400
PIPELINE_S = 2.0
COMMANDS = 16
TWINS = 1
SEED = 1
PARTITION_S = 4.0
SYSTEM_S = 4.0
SYSTEM_LASTS_S = 35.0
LAUNCH_S = 3.0
NAME = "nasrem"


def _switch(workshop: Workshop) -> switch.SwitchCost:
    need_real_time(cores=2)
    return switch.measure()


SWITCH = Experiment(
    "switch",
    "the context switch",
    switch.WAKES * switch.PERIOD_S + LAUNCH_S,
    switch.SwitchCost,
    lambda: {"wakes": switch.WAKES},
    _switch,
)


@dataclass(frozen=True)
class PipelineRun:
    """How many messages took how many cycles down the levels, in lockstep and in real time."""

    predicted: int
    lockstep: dict[int, int]
    realtime: dict[int, int]


def _pipeline(workshop: Workshop) -> PipelineRun:
    predicted = response_ticks([1] * LEVELS)
    return PipelineRun(predicted, _cycles(workshop, "lockstep"), _cycles(workshop, "realtime"))


def _cycles(workshop: Workshop, mode: Mode) -> dict[int, int]:
    """Return how many messages took how many cycles."""
    chain = Chain(LEVELS, RATE_HZ, mode)
    last = f"{chain.names[-1]}.status"
    config = loads(chain.text()).model_copy(update={"name": workshop.rack})
    run = observe(config, PIPELINE_S, workshop.share, [last])
    return responses_of([run.messages[last]])


PIPELINE = Experiment(
    "pipeline",
    "a message down five levels",
    2 * (PIPELINE_S + LAUNCH_S),
    PipelineRun,
    lambda: {"levels": LEVELS, "rate": RATE_HZ, "seconds": PIPELINE_S},
    _pipeline,
)


def _response(workshop: Workshop) -> ResponseBench:
    return ResponseRuns(NAME, "lockstep", SEED, Progress()).measure(COMMANDS, TWINS)


RESPONSE = Experiment(
    "response",
    "holds and resumes by an operator",
    30.0,
    ResponseBench,
    inputs(NAME, commands=COMMANDS, twins=TWINS, seed=SEED),
    _response,
)


def _partition(workshop: Workshop) -> partition.Partitions:
    need_real_time(cores=2)
    return partition.measure(NAME, PARTITION_S, 1, Progress())


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
        f"system-{name}",
        f"{name} next to the other systems",
        SYSTEM_LASTS_S,
        Systems,
        inputs(name, seconds=SYSTEM_S),
        partial(_system, name),
    )


def _system(name: str, workshop: Workshop) -> Systems:
    return measure([name], Runs(SYSTEM_S, 1, workshop.share), Progress())


def compared(each: Sequence[Systems]) -> Systems:
    """Return what was measured of several racks, as one comparison."""
    return Systems(
        tuple(figures for one in each for figures in one.systems), SYSTEM_S, each[0].absent
    )


SYSTEMS = tuple(system_experiment(name) for name in systems())
"""Every rack that models a system, NASREM first."""
