"""Measures the response of a rack to its operator: racks with commands at random ticks, one after
another.

It also checks the serials that the measurement rests on, with twins of a run in which one command
is left out. Until the tick at which the torque first rests on that command both runs are equal bit
for bit. If the command was a hold given to a moving arm, they differ from exactly that tick on.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, NamedTuple

import numpy as np

from rack.boards.config import load, rack_timing, wire
from rack.boards.config.schema import CommandConfig, RackConfig
from rack.levels.timing.command_path import CommandPath, command_paths
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.harness import BenchResult, plain
from rack.tools.lab.benches.observed import UNVIEWED, record
from rack.tools.recording.recording import Recording
from rack.tools.timing.operator_response import AnsweredCommand, OperatorResponse, plot, response_of

RUN_S = 24.0
"""Simulated time of one run, at most."""
LEAD_S = 2.0
"""Simulated time before the first command; by then the arm of a task is about to move."""
PAUSE_S = 1.2
"""Simulated time from the response to a command until the next one, at most, so that the arm moves
again."""
LOCKSTEP_RUN_S = 20.0
"""About how long a run in lockstep takes."""
FRUITLESS = 3
"""Runs in a row without a measured response after which the bench gives up."""
TWIN_EXTRA_TICKS = 40
"""A twin runs for so many ticks after the predicted one."""
MOVING_RAD_S = 0.02


class CommandedRun(NamedTuple):
    """A recorded run, and the commands that it was given."""

    commands: Sequence[CommandConfig]
    recording: Recording


@dataclass(frozen=True)
class Twin:
    """One command, and the first tick at which the torque differs in any bit without it; None: it
    never does."""

    DERIVED: ClassVar = ("agrees",)

    serial: int
    level: str
    given: int
    predicted: int
    differs: int | None

    @property
    def agrees(self) -> bool:
        """Whether that is the predicted tick."""
        return self.differs == self.predicted


@dataclass(frozen=True)
class ResponseBench(BenchResult):
    """All runs together, and the twins."""

    config: str
    mode: str
    seed: int
    runs: int
    response: OperatorResponse
    twins: tuple[Twin, ...]

    @property
    def held(self) -> bool:
        """Whether the responses held and every twin differs at the predicted tick."""
        return self.response.held and all(twin.agrees for twin in self.twins)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        names = ("config", "mode", "seed", "runs", "held")
        head = {name: getattr(self, name) for name in names}
        return {**head, **self.response.document(), "twins": plain(self.twins)}

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield the figures as text for people."""
        yield self.response.text()
        found = self.response
        yield (
            f"{len(found.beyond)} of {len(found.measured)} beyond a bound, {len(found.off)} not at"
            " the predicted tick"
        )
        for twin in self.twins:
            where = "nowhere" if twin.differs is None else f"first at tick {twin.differs}"
            command = f"command {twin.serial} to {twin.level}, given at tick {twin.given}"
            yield f"without {command}, the torque differs {where}; predicted: {twin.predicted}"

    def plot(self, folder: Path) -> list[Path]:
        """Write response.png and response.svg into `folder`; return their paths."""
        return plot(self.response, folder)


class ResponseRuns:
    """Runs racks of one config until enough responses are measured. Raises `Failure` if none can
    be."""

    def __init__(self, name: str, mode: str, seed: int, progress: Progress) -> None:
        self._name = name
        self._mode = mode
        self._seed = seed
        self._progress = progress
        own = f"name=response-{os.getpid()}", f"clock.mode={mode}"
        self._config = load(name, [*own, *UNVIEWED])
        layout = wire(self._config)
        self._paths = command_paths(rack_timing(self._config, layout), layout)
        if not self._paths:
            raise Failure(f"{name}: no level of its hierarchy can be commanded", 2)
        self._random = Random(seed)
        self._runs = 0

    def measure(self, commands: int, twins: int) -> ResponseBench:
        """Measure at least `commands` responses; compare the runs of `twins` holds with their
        twins."""
        per_run = len(self._draw(commands))
        self._progress.total(LOCKSTEP_RUN_S * (commands / max(1, per_run) + 0.7 * twins))
        found: list[OperatorResponse] = []
        compared: list[Twin] = []
        fruitless = 0
        with TemporaryDirectory() as scratch:
            while (left := commands - sum(len(r.measured) for r in found)) > 0:
                run = self._run(self._draw(left + left % 2), Path(scratch) / str(self._runs))
                response = response_of(run.recording)
                measured = len(response.measured) if response is not None else 0
                self._progress.end(LOCKSTEP_RUN_S, f"{measured} responses")
                fruitless = 0 if measured else fruitless + 1
                if fruitless == FRUITLESS:
                    raise Failure(
                        f"{self._name}: {FRUITLESS} runs without a response to any command"
                    )
                if response is not None:
                    found.append(response)
                    compared += self._twins(run, response, twins - len(compared), Path(scratch))
        return ResponseBench(
            self._name, self._mode, self._seed, self._runs, _together(found), tuple(compared)
        )

    def _draw(self, most: int) -> list[CommandConfig]:
        return draw(self._paths, self._config.clock_ns, self._random, most)

    def _run(self, commands: Sequence[CommandConfig], folder: Path) -> CommandedRun:
        self._runs += 1
        self._progress.begin(f"run {self._runs}: {len(commands)} commands")
        return CommandedRun(
            commands, run_commands(self._config, commands, folder, self._seconds(commands))
        )

    def _seconds(self, commands: Sequence[CommandConfig]) -> float:
        """Return the simulated time that the response to the last command needs, and a little
        more."""
        longest = max(path.longest for path in self._paths.values())
        last = max((command.tick or 0 for command in commands), default=0)
        return min(RUN_S, (last + longest) * self._config.clock_ns * 1e-9 + PAUSE_S)

    def _twins(
        self, run: CommandedRun, response: OperatorResponse, most: int, scratch: Path
    ) -> Iterator[Twin]:
        """Yield the twins of holds given to a moving arm: one of every level before a second of
        any."""
        found = holds_of_moving_arm(run.recording, response) if most > 0 else []
        chosen = sorted(
            found, key=lambda c: [o.serial for o in found if o.level == c.level].index(c.serial)
        )
        for command in chosen[: max(0, most)]:
            self._progress.begin(f"twin without command {command.serial} to {command.level}")
            status = _status(response, command.level)
            yield compare(
                self._config, run, command, status, scratch / f"{self._runs}-{command.serial}"
            )
            self._progress.end(0.7 * LOCKSTEP_RUN_S, "compared")


def _together(found: Sequence[OperatorResponse]) -> OperatorResponse:
    """Return all runs as one; serials are unique within a run only."""
    paths = {level: path for response in found for level, path in response.paths.items()}
    ordered = {
        level: paths[level] for level in sorted(paths, key=lambda name: -len(paths[name].levels))
    }
    return replace(
        found[0], paths=ordered, commands=tuple(c for response in found for c in response.commands)
    )


def draw(
    paths: Mapping[str, CommandPath], clock_ns: int, random: Random, most: int
) -> list[CommandConfig]:
    """Return holds and resumes for one run, an even number, at most `most`, to all levels in turn,
    shuffled.

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
            if again + longest >= end or len(drawn) + 2 > most:
                return drawn
            drawn += [CommandConfig(level=level, what="hold", tick=at)]
            drawn += [CommandConfig(level=level, what="resume", tick=again)]
            tick = again + longest


def run_commands(
    config: RackConfig, commands: Sequence[CommandConfig], folder: Path, seconds: float
) -> Recording:
    """Run a rack with these commands for simulated `seconds`, or until its task ends; return its
    recording."""
    wanted = config.model_copy(update={"command": (*config.command, *commands)})
    return record(wanted, seconds, folder).recording


def holds_of_moving_arm(recording: Recording, response: OperatorResponse) -> list[AnsweredCommand]:
    """Return the holds given to a moving arm: it was moving around the predicted tick."""
    holds = [c for c in response.measured if c.what == "hold"]
    return [c for c in holds if _is_moving(recording, _status(response, c.level), c.predicted)]


def _status(response: OperatorResponse, level: str) -> str:
    """Return the mailbox that shows the response to commands to a level: the status of the lowest
    on its path."""
    return f"{response.paths[level].levels[-1]}.status"


def _is_moving(recording: Recording, status: str, tick: int) -> bool:
    """Return whether the arm was commanded to move around a tick; a status without an arm never
    shows it."""
    if not {"target_velocity", "torque"} <= recording.fields(status):
        return False
    ticks = recording.signal(status, "tick")
    speeds = np.abs(recording.signal(status, "target_velocity")).max(axis=1)
    speed = dict(zip(ticks.tolist(), speeds.tolist(), strict=True))
    return all(speed.get(tick + k, 0.0) > MOVING_RAD_S for k in range(-8, 24, 8))


def compare(
    config: RackConfig, run: CommandedRun, command: AnsweredCommand, status: str, folder: Path
) -> Twin:
    """Run the twin of a run without one of its commands, and compare the torques in the mailbox
    `status`."""
    before = [
        other for other in run.commands if other.tick is not None and other.tick < command.given
    ]
    seconds = (command.predicted + TWIN_EXTRA_TICKS) * config.clock_ns * 1e-9
    twin = run_commands(config, before, folder, seconds)
    differs = first_difference(run.recording, twin, status)
    return Twin(command.serial, command.level, command.given, command.predicted, differs)


def first_difference(first: Recording, second: Recording, status: str) -> int | None:
    """Return the first tick at which the torques in `status` differ in any bit, over the ticks that
    both runs have."""
    torques = []
    for recording in (first, second):
        ticks = recording.signal(status, "tick").tolist()
        values = [value.tobytes() for value in recording.signal(status, "torque")]
        torques.append(dict(zip(ticks, values, strict=True)))
    common = sorted(torques[0].keys() & torques[1].keys())
    return next((tick for tick in common if torques[0][tick] != torques[1][tick]), None)
