"""Boards that share processors and the backplane.

Chains of boards run with and without locks, and single boards wait for their cycles by blocking and
by polling.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from rack.backplane.layout import Wake
from rack.boards.config import load_text
from rack.tools.console.answer import Failure
from rack.tools.lab.benches.chain import Chain
from rack.tools.lab.benches.observed import ObservedRun, compute_lateness_us, count_cycles
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop

LEVELS = 5
"""Number of levels of the pipeline: "it would take 5 control cycles"."""
RATE_HZ = 400
SECONDS = 2.0
LAUNCH_S = 2.0
LOCK_PROTOCOL = '\n[protocol]\ndefault = "lock"\n'


@dataclass(frozen=True)
class ChainRun:
    """A run of a chain of empty boards.

    Attributes:
        due: Number of due cycles.
        missed: Number of missed or skipped cycles.
        took: Dictionary from a number of cycles to the number of messages that took it.
    """

    due: int
    missed: int
    took: dict[int, int]


@dataclass(frozen=True)
class Chains:
    """Runs of the pipeline in lockstep, in real time, and with locks."""

    lockstep: ChainRun
    realtime: ChainRun
    locked: ChainRun


def _measure_chains(workshop: Workshop) -> Chains:
    """Measure the pipeline in three runs: in lockstep, in real time, and with locks."""
    return Chains(
        lockstep=_measure_chain("chain-lockstep", workshop, Chain(LEVELS, RATE_HZ, "lockstep")),
        realtime=_measure_chain("chain-realtime", workshop, Chain(LEVELS, RATE_HZ)),
        locked=_measure_chain("chain-locked", workshop, Chain(LEVELS, RATE_HZ), LOCK_PROTOCOL),
    )


def _measure_chain(label: str, workshop: Workshop, chain: Chain, protocol: str = "") -> ChainRun:
    """Run a chain of boards, and count how many messages took each number of cycles."""
    run = _run_chain(label, workshop, chain, protocol)
    missed, due = count_cycles(run.result.tasks[name] for name in chain.names)
    last = f"{chain.names[-1]}.status"
    sent, visible_at = (run.recording.read_signal(last, name) for name in ("sent", "visible_at"))
    # Count a message once, even if a missed cycle repeats it. -1 is sent before the first message.
    sent, first = np.unique(sent, return_index=True)
    took = Counter((visible_at[first] - sent)[sent >= 0].tolist())
    return ChainRun(due, missed, dict(sorted(took.items())))


def _run_chain(label: str, workshop: Workshop, chain: Chain, protocol: str = "") -> ObservedRun:
    """Run and record a chain of boards. `protocol` is TOML text that is added to its config."""
    config = load_text(workshop.find_source(chain.format_config() + protocol))
    return workshop.run(label, config.model_copy(update={"name": workshop.rack}), SECONDS)


CHAINS = Experiment(
    "chains",
    "a message down five levels, with locks too",
    3 * (SECONDS + LAUNCH_S),
    Chains,
    _measure_chains,
    cores=0,
)


@dataclass(frozen=True)
class Waits:
    """Median lateness, in us, of the cycles of an empty board that blocks and of one that polls."""

    blocking_us: float
    polling_us: float


def _measure_waits(workshop: Workshop) -> Waits:
    """Measure the lateness of an empty board that blocks and of one that polls."""
    return Waits(_measure_median_us(workshop, "signal"), _measure_median_us(workshop, "poll"))


def _measure_median_us(workshop: Workshop, wake: Wake) -> float:
    """Return the median lateness, in us, of an empty board with the given method of waiting."""
    chain = Chain(1, RATE_HZ, wake=wake)
    late_us = compute_lateness_us(
        _run_chain(f"waits-{wake}", workshop, chain).recording, chain.names[0]
    )
    if not len(late_us):
        raise Failure(f"a board that waits by {wake} ran no cycle")
    return float(np.median(late_us))


WAITS = Experiment(
    "waits",
    "a board that blocks, and one that polls",
    2 * (SECONDS + LAUNCH_S),
    Waits,
    _measure_waits,
    cores=2,
)
