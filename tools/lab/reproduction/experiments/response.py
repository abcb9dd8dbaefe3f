"""The response of a rack to its operator: holds and resumes at ticks that were drawn at random.

A twin of the run in lockstep, without one command, checks the serials that the measurement rests
on. Until the tick at which the torque first rests on that command both runs are
equal bit for bit. If the command was a hold given to a moving arm, they differ from exactly that
tick on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rack.boards.config.schema import CommandConfig
from rack.tools.console.answer import Failure
from rack.tools.console.tables import render_text
from rack.tools.lab.benches.observed import with_commands
from rack.tools.lab.reproduction.experiments.experiment import Charted, Experiment, Workshop
from rack.tools.recording.recording import Recording
from rack.tools.timing.operator_response import OperatorResponse, response_of

NAME = "nasrem"
HOLDS = (
    ("elemental_move", 861, 1328),
    ("primitive", 1931, 2179),
    ("task", 2438, 3685),
    ("servo", 4793, 5199),
    ("elemental_move", 5659, 6300),
    ("task", 6713, 7848),
)
"""The levels that are held, with the ticks of the hold and of the resume; each is after the
longest response to the one before."""
MOVING_AT = 5659
"""Tick of the hold that meets a moving arm."""
RUN_S = 24.0
"""Simulated time of one run, at most."""
LASTS_S = 62.0
TWIN_EXTRA_TICKS = 40
"""Number of ticks that the twin runs after the predicted one."""
STATUS = "servo.status"
"""The status of the lowest level, with the torque."""


@dataclass(frozen=True)
class ResponseRun(Charted):
    """Commands of an operator in lockstep and in real time.

    Attributes:
        lockstep: Responses in lockstep.
        realtime: Responses in real time.
        predicted: First tick at which the torque in lockstep should differ without the hold at
            `MOVING_AT`.
        differs: First tick at which it differs in any bit. None if it never does.
    """

    lockstep: OperatorResponse
    realtime: OperatorResponse
    predicted: int
    differs: int | None


def _measure(workshop: Workshop) -> ResponseRun:
    run, lockstep = run_commanded(workshop, "lockstep")
    _, realtime = run_commanded(workshop, "realtime")
    predicted = next((one.predicted for one in lockstep.commands if one.given == MOVING_AT), None)
    if predicted is None:
        raise Failure(f"{NAME}: no hold was given at tick {MOVING_AT}")
    return ResponseRun(
        lockstep,
        realtime,
        predicted,
        first_difference(run, _twin(workshop, predicted)),
        chart="\n".join(render_text(realtime.blocks())),
    )


RESPONSE = Experiment(
    "response", "holds and resumes by an operator", LASTS_S, ResponseRun, _measure
)


def run_commanded(workshop: Workshop, mode: str) -> tuple[Recording, OperatorResponse]:
    """Run the rack in a mode with all commands. Raises `Failure` if none had a response."""
    config = with_commands(workshop.config(NAME, [f"clock.mode={mode}"]), list_commands())
    run = workshop.run(f"response-{mode}", config, RUN_S).recording
    response = response_of(run)
    if response is None or not response.measured:
        raise Failure(f"{NAME}: a run without a response to any command")
    return run, response


def _twin(workshop: Workshop, predicted: int) -> Recording:
    """Run the rack in lockstep with the commands before `MOVING_AT` alone."""
    config = workshop.config(NAME, ["clock.mode=lockstep"])
    before = [command for command in list_commands() if (command.tick or 0) < MOVING_AT]
    seconds = (predicted + TWIN_EXTRA_TICKS) * config.clock_ns * 1e-9
    return workshop.run("response-twin", with_commands(config, before), seconds).recording


def list_commands() -> list[CommandConfig]:
    """Return the holds and resumes of a run, in their order."""
    return [
        command
        for level, hold, resume in HOLDS
        for command in (
            CommandConfig(level=level, what="hold", tick=hold),
            CommandConfig(level=level, what="resume", tick=resume),
        )
    ]


def first_difference(first: Recording, second: Recording) -> int | None:
    """Return the first tick at which the torques of two runs in lockstep differ in any bit, over
    the ticks that both have; None if they never do.
    """
    torques = [run.signal(STATUS, "torque").view(np.uint64) for run in (first, second)]
    # In lockstep the level writes in every cycle: messages of the same number have the same tick.
    length = min(map(len, torques))
    differ = (torques[0][:length] != torques[1][:length]).any(axis=1)
    return next(iter(first.signal(STATUS, "tick")[:length][differ].tolist()), None)
