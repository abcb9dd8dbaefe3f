"""NIST's controller before NASREM: state tables, executors alone, and an arm that is disturbed."""

from __future__ import annotations

from typing import Any

from rack.boards.config import load
from rack.tools.reproduction.experiments.experiment import Document, Experiment, Workshop
from rack.tools.runs.history import fired_rows
from rack.tools.runs.measured_response import system_response

NAME = "nist-state-table"
LASTS_S = 10.0


def _inputs() -> Any:
    return {"config": load(NAME).text()}


def _run(workshop: Workshop) -> Document:
    recording = workshop.run(NAME, workshop.config(NAME, ["clock.mode=lockstep"]), None)
    ended = recording.ended
    return {
        "rows": fired_rows(recording),
        "response": system_response(recording),
        "outcome": {**ended["outcome"], "worked": ended["worked"]},
        "clock_ms": recording.rack_config.clock.period_ms,
    }


TABLES = Experiment(NAME, "state tables, its whole task in lockstep", LASTS_S, _inputs, _run)
