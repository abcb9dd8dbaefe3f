"""Response of a rack to its operator: holds and resumes at randomly drawn ticks."""

from __future__ import annotations

from dataclasses import dataclass

from rack.boards.config.command import CommandConfig
from rack.tools.console.answer import Failure
from rack.tools.console.tables import render_text
from rack.tools.lab.reproduction.experiments.experiment import ChartedRecord, Experiment, Workshop
from rack.tools.timing.operator_response import OperatorResponse, measure_response

NAME = "nasrem"
HOLDS = (
    ("elemental_move", 861, 1328),
    ("primitive", 1931, 2179),
    ("task", 2438, 3685),
    ("servo", 4793, 5199),
    ("elemental_move", 5659, 6300),
    ("task", 6713, 7848),
)
"""Levels that are held, with the ticks of the hold and of the resume.

Each command follows the previous one by more than the longest response.
"""
MAX_RUN_S = 24.0
"""Longest simulated time of a run, s."""
EXPECTED_S = 48.0


@dataclass(frozen=True)
class ResponseRun(ChartedRecord):
    """Responses to an operator in lockstep and in real time.

    Attributes:
        lockstep: Responses in lockstep.
        realtime: Responses in real time.
    """

    lockstep: OperatorResponse
    realtime: OperatorResponse


def _measure_response(workshop: Workshop) -> ResponseRun:
    """Run the rack with all commands in both clock modes."""
    lockstep, realtime = (run_with_commands(workshop, mode) for mode in ("lockstep", "realtime"))
    return ResponseRun(lockstep, realtime, chart="\n".join(render_text(realtime.format_blocks())))


RESPONSE = Experiment(
    "response", "holds and resumes by an operator", EXPECTED_S, ResponseRun, _measure_response
)


def run_with_commands(workshop: Workshop, mode: str) -> OperatorResponse:
    """Run the rack with all commands. Raises `Failure` if none of them had a response."""
    config = workshop.load_config(NAME, [f"clock.mode={mode}"])
    commanded = config.model_copy(update={"command": (*config.command, *list_commands())})
    response = measure_response(workshop.run(f"response-{mode}", commanded, MAX_RUN_S).recording)
    if response is None or not response.measured_commands:
        raise Failure(f"{NAME}: no command of the run had a response")
    return response


def list_commands() -> list[CommandConfig]:
    """Return the holds and resumes of a run in chronological order."""
    return [
        command
        for level, hold, resume in HOLDS
        for command in (
            CommandConfig(level=level, what="hold", tick=hold),
            CommandConfig(level=level, what="resume", tick=resume),
        )
    ]
