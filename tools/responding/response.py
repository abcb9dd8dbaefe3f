"""The response to every command that an operator gave in a run: from its giving to the torque that rests on it.

Causality is measured: every command and status carries the serial of the operator's newest command that it rests on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from rack.levels.operator import Answer, What
from rack.tools.console.tables import table
from rack.tools.recording import Recording
from rack.tools.responding.course import Course, acting, courses

Fate = Literal["acted on", "refused", "overtaken", "run over"]


@dataclass(frozen=True)
class Answered:
    """One command, ticks. `predicted` and `acts` are the releases of the cycle whose torque rests on it.

    `acts` is None where no cycle rests on this very command: it was refused, a newer one overtook it, or the run was
    over before. `wall_ms` is the same response by the wall clock, from giving it to writing the status of that cycle.
    """

    serial: int
    level: str
    what: str
    given: int
    sampled: int
    predicted: int
    acts: int | None
    fate: Fate
    wall_ms: float | None = None


@dataclass(frozen=True)
class Response:
    """The response of a run. `tick_ms` is of simulated time; `courses` are by level, those of levels commanded."""

    tick_ms: float
    lockstep: bool
    courses: dict[str, Course]
    commands: tuple[Answered, ...]

    @property
    def measured(self) -> list[Answered]:
        """The commands that a torque came to rest on."""
        return [command for command in self.commands if command.acts is not None]

    def ticks(self, command: Answered) -> int:
        """Return the measured response of one of `measured`, ticks."""
        assert command.acts is not None, "it was acted on"
        return self.courses[command.level].response(command.given, command.acts)

    @property
    def beyond(self) -> list[Answered]:
        """Those whose response was longer than a bound: from giving than the longest on the grid, or from the release
        that reads it, where R_s begins, than eq. 3.2 has it.
        """
        return [command for command in self.measured if self._is_beyond(command)]

    def _is_beyond(self, command: Answered) -> bool:
        course, ticks = self.courses[command.level], self.ticks(command)
        return ticks > course.longest or ticks - (command.sampled - command.given) > course.bound_eq_3_2

    @property
    def off(self) -> list[Answered]:
        """Those whose tick is not the predicted one; where a protocol leaves it open, none is predicted."""
        exact = [c for c in self.measured if self.courses[c.level].is_exact]
        return [command for command in exact if command.acts != command.predicted]

    @property
    def held(self) -> bool:
        """Whether none was beyond a bound and, in lockstep, each came at the predicted tick."""
        return not self.beyond and not (self.lockstep and self.off)

    def rows(self) -> list[dict[str, Any]]:
        """Return the figures of every level that was commanded, ms of simulated time, as plain data."""
        return [self._row(level, course) for level, course in self.courses.items()]

    def _row(self, level: str, course: Course) -> dict[str, Any]:
        mine = [c for c in self.measured if c.level == level]
        ms = np.array([self.ticks(c) for c in mine]) * self.tick_ms
        reading_ms = np.array([self.ticks(c) + c.given - c.sampled for c in mine]) * self.tick_ms
        return {
            "level": level,
            "commands": len(mine),
            "min_ms": _figure(ms, np.min),
            "median_ms": _figure(ms, np.median),
            "max_ms": _figure(ms, np.max),
            "max_from_reading_ms": _figure(reading_ms, np.max),
            "longest_ms": course.longest * self.tick_ms,
            "sum_eq_3_3_ms": course.sum_eq_3_3 * self.tick_ms,
            "bound_eq_3_2_ms": course.bound_eq_3_2 * self.tick_ms,
            "beyond": sum(c.level == level for c in self.beyond),
            "off_prediction": sum(c.level == level for c in self.off),
        }

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        commands = [asdict(c) | {"ticks": self.ticks(c) if c.acts is not None else None} for c in self.commands]
        head = {"lockstep": self.lockstep, "tick_ms": self.tick_ms, "commands": len(self.commands)}
        figures = {"measured": len(self.measured), "beyond": len(self.beyond), "off_prediction": len(self.off)}
        return {**head, **figures, "levels": self.rows(), "each": commands}

    def text(self, width: int | None = None) -> str:
        """Return the figures as text for people, the table into `width`."""
        return "\n".join(self._lines(width))

    def _lines(self, width: int | None) -> Iterator[str]:
        yield f"response to {len(self.measured)} commands of an operator, ms of simulated time, to the end of the cycle"
        yield "whose torque rests on it: from its giving, and from the release that reads it"
        head = ["given to", "commands", "min", "median", "max", "longest on the grid"]
        head += ["max from reading", "sum, eq. 3.3", "bound, eq. 3.2", "beyond", "off prediction"]
        yield from table(head, [[*self._cells(row)] for row in self.rows()], width, ("min", "sum, eq. 3.3", "median"))
        others = [command for command in self.commands if command.acts is None]
        if others:
            told = ", ".join(f"{c.serial} to {c.level} ({c.fate})" for c in others)
            yield f"not measured: {told}"
        for command in self.off:
            late = (command.acts or 0) - command.predicted
            yield f"command {command.serial} to {command.level}, given at tick {command.given}: {late:+d} ticks"

    def _cells(self, row: dict[str, Any]) -> Iterator[str]:
        yield from (row["level"], str(row["commands"]))
        for name in ("min_ms", "median_ms", "max_ms", "longest_ms"):
            yield _shown(row[name])
        for name in ("max_from_reading_ms", "sum_eq_3_3_ms", "bound_eq_3_2_ms"):
            yield _shown(row[name])
        yield from (str(row["beyond"]), str(row["off_prediction"]))


def response_of(recording: Recording) -> Response | None:
    """Return the response of a run; None where no operator commanded a level of the hierarchy."""
    config, layout = recording.rack_config, recording.layout
    found = courses(config, layout)
    given = [level for level in found if f"{level}.operator" in recording.mailboxes]
    if not given:
        return None
    lowest = f"{acting([found[level] for level in given])}.status"
    rests_on, ticks, stamps = (recording.signal(lowest, name) for name in ("operator", "tick", "stamp_ns"))
    commands = [one for level in given for one in _commands(recording, level, found[level])]
    answered = [_follow(command, stamp, rests_on, ticks, stamps) for command, stamp in commands]
    lockstep = config.clock.mode == "lockstep"
    if lockstep:
        answered = [replace(command, wall_ms=None) for command in answered]
    answered.sort(key=lambda command: command.serial)
    return Response(layout.clock_ns * 1e-6, lockstep, {level: found[level] for level in given}, tuple(answered))


def _commands(recording: Recording, level: str, course: Course) -> Iterator[tuple[Answered, int]]:
    """Yield the commands that were given to a level, with the time at which, ns."""
    box, status = f"{level}.operator", f"{level}.status"
    # A clock that died while it gave one has given it twice: the first counts.
    serials, at = np.unique(recording.signal(box, "id"), return_index=True)
    whats, given, visible, stamps = (recording.signal(box, n)[at] for n in ("what", "tick", "visible_at", "stamp_ns"))
    orders, answers = recording.signal(status, "order"), recording.signal(status, "answer")
    refused = set(orders[answers == Answer.REFUSED].tolist())
    for serial, what, tick, seen, stamp in zip(serials, whats, given, visible, stamps, strict=True):
        yield (
            Answered(
                serial=int(serial),
                level=level,
                what=What(int(what)).name.lower(),
                given=int(tick),
                sampled=course.samples_at(int(seen)),
                predicted=course.acts_at(int(seen)),
                acts=None,
                fate="refused" if int(serial) in refused else "run over",
            ),
            int(stamp),
        )


def _follow(command: Answered, given_ns: int, rests_on: np.ndarray, ticks: np.ndarray, stamps: np.ndarray) -> Answered:
    """Return the command with the first cycle of the lowest level that rests on it, or on a newer one."""
    if command.fate == "refused" or not len(rests_on) or rests_on.max() < command.serial:
        return command
    first = int(np.argmax(rests_on >= command.serial))
    if rests_on[first] != command.serial:
        return replace(command, fate="overtaken")
    wall_ms = round((int(stamps[first]) - given_ns) * 1e-6, 6)
    return replace(command, acts=int(ticks[first]), fate="acted on", wall_ms=wall_ms)


def _figure(values: np.ndarray, of: Any) -> float | None:
    return float(of(values)) if len(values) else None


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
