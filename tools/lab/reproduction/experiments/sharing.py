"""How boards share processors and the backplane: chains of them, with locks too, and how a board
waits for its cycle."""

from __future__ import annotations

import os
from dataclasses import dataclass

from pydantic import TypeAdapter

from rack.backplane.layout import Wake
from rack.boards.config import loads
from rack.levels.timing.trace_times import Distribution, distribution
from rack.tools.lab.benches.boards import responses_of
from rack.tools.lab.benches.chain import PRIORITY, Chain
from rack.tools.lab.benches.clock import board
from rack.tools.lab.benches.cyclictest import WakeGrid
from rack.tools.lab.benches.observed import observe
from rack.tools.lab.reproduction.experiments.experiment import (
    Experiment,
    Workshop,
    need_real_time,
)

LEVELS = 5
"""Levels of the pipeline: "it would take 5 control cycles"."""
GROWN = 10
RATE_HZ = 400
SECONDS = 2.0
LAUNCH_S = 2.0
LOCKS = '\n[protocol]\ndefault = "lock"\n'
WAYS: tuple[Wake, ...] = ("signal", "poll")


@dataclass(frozen=True)
class ChainRun:
    """A chain of empty boards: cycles due, those missed or skipped, and how many messages took how
    many cycles."""

    boards: int
    due: int
    missed: int
    took: dict[int, int]


@dataclass(frozen=True)
class Chains:
    """The pipeline in lockstep and in real time, one with locks, and one that has grown."""

    lockstep: ChainRun
    realtime: ChainRun
    locked: ChainRun
    grown: ChainRun


def _chains(workshop: Workshop) -> Chains:
    return Chains(
        lockstep=_chain(workshop, Chain(LEVELS, RATE_HZ, "lockstep")),
        realtime=_chain(workshop, Chain(LEVELS, RATE_HZ)),
        locked=_chain(workshop, Chain(LEVELS, RATE_HZ), LOCKS),
        grown=_chain(workshop, Chain(GROWN, RATE_HZ)),
    )


def _chain(workshop: Workshop, chain: Chain, protocol: str = "") -> ChainRun:
    last = f"{chain.names[-1]}.status"
    config = loads(workshop.source(chain.text() + protocol))
    run = observe(
        config.model_copy(update={"name": workshop.rack}), SECONDS, workshop.share, [last]
    )
    missed, due = map(sum, zip(*map(run.cycles, chain.names), strict=True))
    return ChainRun(chain.boards, due, missed, responses_of([run.messages[last]]))


CHAINS = Experiment(
    "chains",
    "a message down five levels, with locks too, and down ten",
    4 * (SECONDS + LAUNCH_S),
    Chains,
    _chains,
)


@dataclass(frozen=True)
class Waits:
    """How late an empty board starts its cycles, us, by how it waits for them."""

    late_us: dict[Wake, Distribution]


def _waits(workshop: Workshop) -> Waits:
    need_real_time(cores=2)
    grid = WakeGrid.at((max(os.sched_getaffinity(0)),), RATE_HZ, SECONDS, PRIORITY)
    late_us = {wake: distribution(board(wake, workshop.share, grid)) for wake in WAYS}
    return TypeAdapter(Waits).validate_python({"late_us": late_us})


WAITS = Experiment(
    "waits",
    "a board that blocks, and one that polls",
    len(WAYS) * (SECONDS + LAUNCH_S),
    Waits,
    _waits,
)
