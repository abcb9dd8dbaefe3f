"""Boards that die and sensors that fail, by scripts of faults: how many ticks until each is
detected, and what then."""

from __future__ import annotations

from functools import partial

from rack.boards.config import load
from rack.tools.faults.judge import faults
from rack.tools.lab.reproduction.experiments.experiment import Document, Experiment, Workshop
from rack.tools.recording.history import holds

NAME = "nasrem"
LASTS_S = 13.0


def losses_of(script: str, about: str) -> Experiment:
    """Return a run of the rack's whole task in lockstep with a script of faults."""
    return Experiment(
        script,
        about,
        LASTS_S,
        lambda: {"config": load(NAME, ["clock.mode=lockstep"], script).text()},
        partial(_run, script),
    )


def _run(script: str, workshop: Workshop) -> Document:
    recording = workshop.run(script, workshop.config(NAME, ["clock.mode=lockstep"], script), None)
    found = faults(recording.events, recording.layout)
    ended = recording.ended
    return {
        "faults": found["faults"],
        "unexplained": found["unexplained"],
        "restarts": found["restarts"],
        "outcome": {**ended["outcome"], "worked": ended["worked"]},
        "holds": holds(recording),
        "clock_ms": recording.rack_config.clock.period_ms,
    }


KILLS = losses_of("kill-each-board", "every board of nasrem killed once")
SENSORS = losses_of("bad-sensors", "the sensors of nasrem failing one way after another")
