"""Boards that die and sensors that fail, by scripts of faults, with the time until each is
detected and recovered from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from pydantic import TypeAdapter

from rack.tools.faults.judge import Judgement, faults
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop

NAME = "nasrem"
LASTS_S = 34.0


@dataclass(frozen=True)
class LossesRun:
    """A run with a script of faults: each fault, and whether the run worked."""

    faults: tuple[Judgement, ...]
    worked: bool


def _measure(script: str, workshop: Workshop) -> LossesRun:
    """Run the rack's whole task in real time with a script of faults."""
    result, recording = workshop.run(script, workshop.config(NAME, (), script))
    found = faults(recording.events, recording.layout)["faults"]
    return LossesRun(TypeAdapter(tuple[Judgement, ...]).validate_python(found), result.worked)


KILLS, SENSORS = (
    Experiment(script, about, LASTS_S, LossesRun, partial(_measure, script))
    for script, about in (
        ("kill-each-board", "every board of nasrem killed once"),
        ("bad-sensors", "the sensors of nasrem failing one way after another"),
    )
)
