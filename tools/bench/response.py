"""The response of a rack to its operator, measured: racks with commands at random ticks, one after another."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

from rack.boards.config import load, wire
from rack.boards.operating.config import CommandConfig
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.recording import Recording
from rack.tools.responding.course import courses
from rack.tools.responding.response import Response, response_of
from rack.tools.responding.schedule import BREATH_S, RUN_S, draw
from rack.tools.responding.trial import run
from rack.tools.responding.twin import Twin, candidates, compare

LOCKSTEP_RUN_S = 20.0
"""What a run in lockstep takes, about."""
FRUITLESS = 3
"""Runs in a row without one measured response after which the bench gives up."""


@dataclass(frozen=True)
class Measured:
    """All runs together, and the twins."""

    config: str
    mode: str
    seed: int
    runs: int
    response: Response
    twins: tuple[Twin, ...]

    @property
    def held(self) -> bool:
        """Whether the responses held, and the serials told the truth."""
        return self.response.held and all(twin.agrees for twin in self.twins)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        head = {"config": self.config, "mode": self.mode, "seed": self.seed, "runs": self.runs, "held": self.held}
        return {**head, **self.response.document(), "twins": [asdict(t) | {"agrees": t.agrees} for t in self.twins]}

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield the figures as text for people, the table into `width`."""
        yield self.response.text(width)
        count = len(self.response.measured)
        yield f"{len(self.response.beyond)} of {count} beyond a bound, {len(self.response.off)} off the predicted tick"
        for twin in self.twins:
            seen = "nowhere" if twin.differs is None else f"first at tick {twin.differs}"
            told = (
                f"without command {twin.serial} to {twin.level}, given at tick {twin.given}, the torque differs {seen}"
            )
            yield f"{told}; predicted: {twin.predicted}"


class Bench:
    """Runs racks of one config until enough commands were measured. Raises `Failure` where none can be."""

    def __init__(self, name: str, mode: str, seed: int, progress: Progress) -> None:
        self._name, self._mode, self._seed, self._progress = name, mode, seed, progress
        self._config = load(name, [f"name=response-{os.getpid()}", f"clock.mode={mode}"])
        layout = wire(self._config)
        self._courses = courses(self._config, layout)
        if not self._courses:
            raise Failure(f"{name}: no level of its hierarchy can be commanded", 2)
        self._random = Random(seed)
        self._runs = 0

    def measure(self, commands: int, twins: int) -> Measured:
        """Measure at least `commands` responses; compare the runs of `twins` holds with their twins."""
        per_run = len(self._draw(commands))
        self._progress.total(LOCKSTEP_RUN_S * (commands / max(1, per_run) + 0.7 * twins))
        found: list[Response] = []
        compared: list[Twin] = []
        fruitless = 0
        with TemporaryDirectory() as scratch:
            while (left := commands - sum(len(r.measured) for r in found)) > 0:
                drawn = self._draw(left + left % 2)
                recording, response = self._run(drawn, Path(scratch) / str(self._runs))
                fruitless = 0 if response is not None and response.measured else fruitless + 1
                if fruitless == FRUITLESS:
                    raise Failure(f"{self._name}: {FRUITLESS} runs without a response to any command")
                if response is not None:
                    found.append(response)
                    compared += self._twins(recording, response, drawn, twins - len(compared), Path(scratch))
        return Measured(self._name, self._mode, self._seed, self._runs, _together(found), tuple(compared))

    def _draw(self, most: int) -> list[CommandConfig]:
        return draw(self._courses, self._config.clock_ns, self._random, most)

    def _run(self, commands: Sequence[CommandConfig], folder: Path) -> tuple[Recording, Response | None]:
        self._runs += 1
        self._progress.begin(f"run {self._runs}: {len(commands)} commands")
        recording = run(self._config, commands, folder, self._seconds(commands))
        response = response_of(recording)
        measured = len(response.measured) if response is not None else 0
        self._progress.end(LOCKSTEP_RUN_S, f"{measured} responses", [])
        return recording, response

    def _seconds(self, commands: Sequence[CommandConfig]) -> float:
        """Return the simulated time in which the last command is answered, and a little more."""
        longest = max(course.longest for course in self._courses.values())
        last = max((command.tick or 0 for command in commands), default=0)
        return min(RUN_S, (last + longest) * self._config.clock_ns * 1e-9 + BREATH_S)

    def _twins(
        self, recording: Recording, response: Response, drawn: Sequence[CommandConfig], most: int, scratch: Path
    ) -> Iterator[Twin]:
        """Yield the twins of holds that met a moving arm: of every level one before any has a second."""
        found = candidates(recording, response) if most > 0 else []
        chosen = sorted(found, key=lambda c: [o.serial for o in found if o.level == c.level].index(c.serial))
        for command in chosen[: max(0, most)]:
            self._progress.begin(f"twin without command {command.serial} to {command.level}")
            yield compare(self._config, drawn, recording, command, scratch / f"{self._runs}-{command.serial}")
            self._progress.end(0.7 * LOCKSTEP_RUN_S, "compared", [])


def _together(found: Sequence[Response]) -> Response:
    """Return all runs as one: serials are of each run."""
    courses_ = {level: course for response in found for level, course in response.courses.items()}
    ordered = {level: courses_[level] for level in sorted(courses_, key=lambda name: -len(courses_[name].levels))}
    return replace(found[0], courses=ordered, commands=tuple(c for response in found for c in response.commands))
