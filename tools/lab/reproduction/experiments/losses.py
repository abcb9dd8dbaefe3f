"""Boards that die and sensors that fail, by scripts of faults: how many ticks until each is
detected, and what then."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from pydantic import TypeAdapter

from rack.tools.faults.judge import Judgement, faults
from rack.tools.lab.reproduction.experiments.experiment import (
    Experiment,
    Workshop,
    need_real_time,
)

NAME = "nasrem"
LASTS_S = 34.0


@dataclass(frozen=True)
class LossesRun:
    """A run with a script of faults: each fault, and whether the run worked."""

    faults: tuple[Judgement, ...]
    worked: bool


def losses_of(script: str, about: str) -> Experiment[LossesRun]:
    """Return a run of the rack's whole task in real time with a script of faults."""
    return Experiment(
        script,
        about,
        LASTS_S,
        LossesRun,
        partial(_run, script),
    )


def _run(script: str, workshop: Workshop) -> LossesRun:
    need_real_time()
    config = workshop.config(NAME, (), script)
    result, recording = workshop.run(script, config)
    found = faults(recording.events, recording.layout)["faults"]
    return LossesRun(TypeAdapter(tuple[Judgement, ...]).validate_python(found), result.worked)


KILLS = losses_of("kill-each-board", "every board of nasrem killed once")
SENSORS = losses_of("bad-sensors", "the sensors of nasrem failing one way after another")
