"""Response of a rack to its operator: holds and resumes at randomly drawn ticks.

A second lockstep run without one of the commands, the twin, checks the serials on which the
measurement depends. Up to the tick at which the torque first depends on that command, both runs are
equal bit for bit. If the command was a hold of a moving arm, they differ from exactly that tick on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rack.boards.config.schema import CommandConfig
from rack.tools.console.answer import Failure
from rack.tools.console.tables import render_text
from rack.tools.lab.benches.observed import add_commands
from rack.tools.lab.reproduction.experiments.experiment import ChartedRecord, Experiment, Workshop
from rack.tools.recording.recording import Recording
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
MOVING_HOLD_TICK = 5659
"""Tick of the hold that is given while the arm moves."""
MAX_RUN_S = 24.0
"""Longest simulated time of a run, s."""
EXPECTED_S = 62.0
TWIN_EXTRA_TICKS = 40
"""Number of ticks that the twin runs after the predicted one."""
STATUS = "servo.status"
"""Mailbox of the status of the lowest level, which contains the torque."""


@dataclass(frozen=True)
class ResponseRun(ChartedRecord):
    """Responses to an operator in lockstep and in real time.

    Attributes:
        lockstep: Responses in lockstep.
        realtime: Responses in real time.
        predicted: Predicted first tick at which the torque in lockstep differs without the hold at
            `MOVING_HOLD_TICK`.
        differs: First tick at which it differs in any bit. None if it never does.
    """

    lockstep: OperatorResponse
    realtime: OperatorResponse
    predicted: int
    differs: int | None


def _measure_response(workshop: Workshop) -> ResponseRun:
    """Run the rack in both clock modes, and in lockstep again without the hold of the moving arm.

    The second lockstep run shows at which tick the torque begins to depend on this hold.
    """
    run, lockstep = run_with_commands(workshop, "lockstep")
    _, realtime = run_with_commands(workshop, "realtime")
    predicted = next((c.predicted for c in lockstep.commands if c.given == MOVING_HOLD_TICK), None)
    if predicted is None:
        raise Failure(f"{NAME}: no hold was given at tick {MOVING_HOLD_TICK}")
    return ResponseRun(
        lockstep,
        realtime,
        predicted,
        find_first_difference(run, _run_twin(workshop, predicted)),
        chart="\n".join(render_text(realtime.format_blocks())),
    )


RESPONSE = Experiment(
    "response", "holds and resumes by an operator", EXPECTED_S, ResponseRun, _measure_response
)


def run_with_commands(workshop: Workshop, mode: str) -> tuple[Recording, OperatorResponse]:
    """Run the rack with all commands. Raises `Failure` if none of them had a response."""
    config = add_commands(workshop.load_config(NAME, [f"clock.mode={mode}"]), list_commands())
    run = workshop.run(f"response-{mode}", config, MAX_RUN_S).recording
    response = measure_response(run)
    if response is None or not response.measured_commands:
        raise Failure(f"{NAME}: no command of the run had a response")
    return run, response


def _run_twin(workshop: Workshop, predicted: int) -> Recording:
    """Run the rack in lockstep with only the commands before `MOVING_HOLD_TICK`."""
    config = workshop.load_config(NAME, ["clock.mode=lockstep"])
    before = [command for command in list_commands() if (command.tick or 0) < MOVING_HOLD_TICK]
    seconds = (predicted + TWIN_EXTRA_TICKS) * config.clock_ns * 1e-9
    return workshop.run("response-twin", add_commands(config, before), seconds).recording


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


def find_first_difference(first: Recording, second: Recording) -> int | None:
    """Return the first tick at which the torques of two lockstep runs differ in any bit.

    Only ticks that both runs contain are compared. None if the torques never differ.
    """
    torques = [run.read_signal(STATUS, "torque").view(np.uint64) for run in (first, second)]
    # In lockstep the level writes in every cycle, therefore messages with the same index have the
    # same tick.
    length = min(map(len, torques))
    is_different = (torques[0][:length] != torques[1][:length]).any(axis=1)
    return next(iter(first.read_signal(STATUS, "tick")[:length][is_different].tolist()), None)
