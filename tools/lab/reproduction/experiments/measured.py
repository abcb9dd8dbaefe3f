"""Measurements that `rack bench` makes too: context switch, pipeline, response to an operator,
partitions."""

from __future__ import annotations

from collections.abc import Mapping

from rack.boards.config import load, loads
from rack.levels.timing.equations import response_ticks
from rack.tools.console.progress import Progress
from rack.tools.lab.benches import partition, switch
from rack.tools.lab.benches.boards import responses_of
from rack.tools.lab.benches.chain import Chain
from rack.tools.lab.benches.observed import observe
from rack.tools.lab.benches.response import ResponseRuns
from rack.tools.lab.reproduction.experiments.experiment import (
    PICTURES,
    Document,
    Experiment,
    Workshop,
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
LAUNCH_S = 3.0
NAME = "nasrem"


def _switch(workshop: Workshop) -> Document:
    need_real_time(cores=2)
    return switch.measure().document()


SWITCH = Experiment(
    "switch",
    "the context switch",
    switch.WAKES * switch.PERIOD_S + LAUNCH_S,
    lambda: {"wakes": switch.WAKES},
    _switch,
)


def _pipeline(workshop: Workshop) -> Document:
    chains = {mode: Chain(LEVELS, RATE_HZ, mode) for mode in ("lockstep", "realtime")}
    last = f"{chains['lockstep'].names[-1]}.status"
    found: dict[str, Mapping[int, int]] = {}
    for mode, chain in chains.items():
        config = loads(chain.text()).model_copy(update={"name": workshop.rack})
        run = observe(config, PIPELINE_S, workshop.share, [last])
        found[mode] = responses_of([run.messages[last]])
    return {
        "levels": LEVELS,
        "rate_hz": RATE_HZ,
        "predicted": response_ticks([1] * LEVELS),
        "cycles": found,
    }


PIPELINE = Experiment(
    "pipeline",
    "a message down five levels",
    2 * (PIPELINE_S + LAUNCH_S),
    lambda: {"levels": LEVELS, "rate": RATE_HZ, "seconds": PIPELINE_S},
    _pipeline,
)


def _response(workshop: Workshop) -> Document:
    found = ResponseRuns(NAME, "lockstep", SEED, Progress()).measure(COMMANDS, TWINS)
    paths = found.plot(workshop.folder / PICTURES)
    return {**found.document(), "pictures": {"response": workshop.shown(paths)}}


RESPONSE = Experiment(
    "response",
    "holds and resumes by an operator",
    30.0,
    lambda: {"config": load(NAME).text(), "commands": COMMANDS, "twins": TWINS, "seed": SEED},
    _response,
)


def _partition(workshop: Workshop) -> Document:
    need_real_time(cores=2)
    return partition.measure(NAME, PARTITION_S, 1, Progress()).document()


PARTITION = Experiment(
    "partition",
    "nasrem with its planners on one core and on two",
    len(partition.PARTITIONS) * (PARTITION_S + LAUNCH_S),
    lambda: {"config": load(NAME).text(), "seconds": PARTITION_S},
    _partition,
)
