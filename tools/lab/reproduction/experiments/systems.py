"""The paper's other systems: each rack measured by itself, as `rack bench systems` does."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from rack.boards.config import load
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.observed import Runs
from rack.tools.lab.benches.systems.bench import measure, systems
from rack.tools.lab.benches.systems.tables import Systems
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop

SECONDS = 4.0
LASTS_S = 35.0
PREFIX = "system-"


def system_experiment(name: str) -> Experiment[Systems]:
    """Return the figures of one rack, in lockstep and in real time."""
    return Experiment(
        f"{PREFIX}{name}",
        f"{name} next to the other systems",
        LASTS_S,
        Systems,
        lambda: {"config": load(name).text(), "seconds": SECONDS},
        partial(_run, name),
    )


def _run(name: str, workshop: Workshop) -> Systems:
    return measure([name], Runs(SECONDS, 1, workshop.share), Progress())


def compared(each: Sequence[Systems]) -> Systems:
    """Return what was measured of several racks, as one comparison."""
    return Systems(
        tuple(figures for one in each for figures in one.systems), SECONDS, each[0].absent
    )


SYSTEMS = tuple(system_experiment(name) for name in systems())
"""Every rack that models a system, NASREM first."""
