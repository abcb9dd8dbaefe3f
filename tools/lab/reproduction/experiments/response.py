"""The response of a rack to its operator: holds and resumes at random ticks.

A twin of the run in lockstep, in which one command is left out, checks the serials that the
measurement rests on. Until the tick at which the torque first rests on that command both runs are
equal bit for bit. If the command was a hold given to a moving arm, they differ from exactly that
tick on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from random import Random

import numpy as np

from rack.boards.config import rack_timing, wire
from rack.boards.config.schema import CommandConfig
from rack.levels.timing.command_path import CommandPath, command_paths
from rack.tools.console.answer import Failure
from rack.tools.console.tables import render_text
from rack.tools.lab.benches.observed import with_commands
from rack.tools.lab.reproduction.experiments.experiment import Charted, Experiment, Workshop
from rack.tools.recording.recording import Recording
from rack.tools.timing.operator_response import AnsweredCommand, OperatorResponse, response_of

NAME = "nasrem"
COMMANDS = 12
TWINS = 1
SEED = 1
RUN_S = 24.0
"""Simulated time of one run, at most."""
LEAD_S = 2.0
"""Simulated time before the first command; by then the arm of a task is about to move."""
PAUSE_S = 1.2
"""Simulated time from the response to a command until the next one, at most, so that the arm moves
again."""
LASTS_S = 62.0
TWIN_EXTRA_TICKS = 40
"""A twin runs for so many ticks after the predicted one."""
MOVING_RAD_S = 0.02


@dataclass(frozen=True)
class Twin:
    """One command, and the first tick at which the torque differs in any bit without it; None: it
    never does."""

    level: str
    predicted: int
    differs: int | None

    @property
    def agrees(self) -> bool:
        """Whether that is the predicted tick."""
        return self.differs == self.predicted


@dataclass(frozen=True)
class ResponseFigures:
    """The responses of one run, and its twins."""

    response: OperatorResponse
    twins: tuple[Twin, ...]


@dataclass(frozen=True)
class ResponseRun(Charted):
    """Commands of an operator in lockstep, with twins that show which torque rests on one, and in
    real time."""

    lockstep: ResponseFigures
    realtime: ResponseFigures


def _measure(workshop: Workshop) -> ResponseRun:
    lockstep = measure_response(workshop, "lockstep", TWINS)
    realtime = measure_response(workshop, "realtime", 0)
    chart = "\n".join(render_text(realtime.response.blocks()))
    return ResponseRun(lockstep, realtime, chart=chart)


RESPONSE = Experiment(
    "response", "holds and resumes by an operator", LASTS_S, ResponseRun, _measure
)


def measure_response(workshop: Workshop, mode: str, twins: int) -> ResponseFigures:
    """Run the rack in a mode with commands at random ticks, and the twins of at most so many
    holds. Raises `Failure` if no command had a response."""
    config = workshop.config(NAME, [f"clock.mode={mode}"])
    layout = wire(config)
    paths = command_paths(rack_timing(config, layout), layout)
    commands = draw_commands(paths, config.clock_ns, Random(SEED))
    run = workshop.run(f"response-{mode}", with_commands(config, commands), RUN_S).recording
    response = response_of(run)
    if response is None or not response.measured:
        raise Failure(f"{NAME}: a run without a response to any command")
    compared = []
    for hold in find_holds(run, response)[:twins]:
        # The twin runs without this command, and without those after it.
        before = [command for command in commands if (command.tick or 0) < hold.given]
        seconds = (hold.predicted + TWIN_EXTRA_TICKS) * config.clock_ns * 1e-9
        label = f"response-without-{hold.serial}"
        twin = workshop.run(label, with_commands(config, before), seconds).recording
        differs = first_difference(run, twin, lowest_status(response, hold.level))
        compared.append(Twin(hold.level, hold.predicted, differs))
    return ResponseFigures(response, tuple(compared))


def draw_commands(
    paths: Mapping[str, CommandPath], clock_ns: int, random: Random
) -> list[CommandConfig]:
    """Return holds and resumes for one run, at most `COMMANDS`, to all levels in turn, shuffled.

    Each is given after the response to the one before, and a random pause. Pauses are longer than
    the longest cycle, or many of them, so that every phase of the grid is equally likely.
    """
    drawn: list[CommandConfig] = []
    tick, end, pause = (round(seconds * 1e9 / clock_ns) for seconds in (LEAD_S, RUN_S, PAUSE_S))
    while True:
        for level in random.sample(list(paths), len(paths)):
            at = tick + random.randint(1, pause)
            longest = paths[level].longest
            again = at + longest + random.randint(1, pause)
            if again + longest >= end or len(drawn) + 2 > COMMANDS:
                return drawn
            drawn += [CommandConfig(level=level, what="hold", tick=at)]
            drawn += [CommandConfig(level=level, what="resume", tick=again)]
            tick = again + longest


def find_holds(run: Recording, response: OperatorResponse) -> list[AnsweredCommand]:
    """Return the holds given to a moving arm: it was moving around the predicted tick."""
    return [
        command
        for command in response.measured
        if command.what == "hold"
        and _is_moving(run, lowest_status(response, command.level), command.predicted)
    ]


def lowest_status(response: OperatorResponse, level: str) -> str:
    """Return the status of the lowest level on the path of commands to a level."""
    return f"{response.paths[level].levels[-1]}.status"


def _is_moving(run: Recording, status: str, tick: int) -> bool:
    ticks = run.signal(status, "tick")
    speeds = np.abs(run.signal(status, "target_velocity")).max(axis=1)
    around = (ticks >= tick - 8) & (ticks <= tick + 16)
    return bool(around.any() and (speeds[around] > MOVING_RAD_S).all())


def first_difference(first: Recording, second: Recording, status: str) -> int | None:
    """Return the first tick at which the torques in `status` differ in any bit, over the ticks that
    both runs have; None if they never do."""
    ticks, *places = np.intersect1d(
        first.signal(status, "tick"), second.signal(status, "tick"), return_indices=True
    )
    bits, others = (
        run.signal(status, "torque")[place].view(np.uint64)
        for run, place in zip((first, second), places, strict=True)
    )
    differing = ticks[(bits != others).any(axis=1)]
    return int(differing[0]) if len(differing) else None
