"""The operator's desk of a running rack, from outside: hands a command over, and waits for its level's answer."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from typing import Any

from rack.backplane.operator_table import OperatorTable, RequestEntry, RequestStage, RequestWord
from rack.backplane.protocols import open_observer
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.config import loads
from rack.boards.config.commands import asked, commandable, request
from rack.boards.errors import ConfigError, Mistake
from rack.boards.operating.command import describe, message_of
from rack.levels.operator import Operation, listed
from rack.tools.answer import Failure
from rack.tools.commanding.answers import Answers, answering
from rack.tools.commanding.patience import SILENT_S, Patience
from rack.tools.commanding.told import Told
from rack.tools.holds import resume_command
from rack.tools.text_table import table

ANSWER_CYCLES = 4
"""Cycles of a level in which it answers: one to be read, one to be seen, and two that may be missed."""


class LiveDesk:
    """The desk of one rack. Raises `SegmentError` when there is none."""

    def __init__(self, rack: str) -> None:
        self._segment = Segment.attach(rack)
        self._config = loads(self._segment.config)
        self._table = OperatorTable(self._segment)

    def levels(self) -> list[dict[str, str]]:
        """Return what an operator may tell each level, and what stands there now, as plain data."""
        known = commandable(self._config)
        return [{"level": name, "stands": self._stands(name), "takes": listed(takes)} for name, takes in known.items()]

    def text(self, width: int | None = None) -> Iterator[str]:
        """Yield the same as a table, into `width`."""
        yield from table(["level", "in force", "takes"], [list(row.values()) for row in self.levels()], width)

    def give(self, given: Mapping[str, Any], wait: bool, timeout_s: float | None = None) -> Told:
        """Hand a command over and wait for its level to take it up, with `wait` until that is done.

        `timeout_s` of wall-clock time is the bound of that wait; None: the end of the run is.

        Raises `ConfigError` with every mistake, and `Failure` when it is not given, or not answered in time.
        """
        segment, tick = self._segment, self._segment.words[System.TICK]
        command = asked({key: value for key, value in given.items() if value is not None})
        wanted = request(command, self._config, segment.layout)
        if 0 <= wanted.tick <= tick:
            key, value = ("tick", command.tick) if command.at is None else ("at", command.at)
            raise ConfigError([Mistake(key, value, f"has passed; the rack is at tick {tick}")])
        if Patience(segment, "").is_in_vain:
            raise Failure(f"rack '{segment.rack}': its run is over")
        # However the wait ends, nothing is left that would be given when nobody asks for it any more.
        with self._table.claim(wanted) as entry:
            ticket, text = entry[RequestWord.TICKET], describe(message_of(entry, segment.layout))
            told = self._await_giving(entry, ticket, command.level, text)
        return self._await_answer(told, wait, timeout_s)

    def _await_giving(self, entry: RequestEntry, ticket: int, level: str, text: str) -> Told:
        about = f"'{level}', {text}"
        patience = Patience(self._segment, f"{about}: waiting for tick {max(0, entry[RequestWord.TICK])}")
        while entry[RequestWord.TICKET] == ticket:
            if entry.stage == RequestStage.GIVEN:
                return Told(entry[RequestWord.SERIAL], level, text, entry[RequestWord.GIVEN_TICK])
            if patience.is_in_vain:
                raise Failure(f"{about}: the run ended before it was given")
            if not patience.look_again():
                raise Failure(f"{about}: not given, the clock has given out no tick for {SILENT_S:g} s")
        raise Failure(f"{about}: given, but so many others since that its answer is lost")

    def _await_answer(self, told: Told, wait: bool, timeout_s: float | None) -> Told:
        deadline = math.inf if timeout_s is None else time.monotonic() + timeout_s
        status = answering(self._segment, told.level)
        if status is None:
            return told
        answers = Answers(self._segment, status, told)
        last = told.given + ANSWER_CYCLES * status.every
        patience = Patience(
            self._segment, f"command {told.serial}: waiting for '{told.level}', which runs every {status.every} ticks"
        )
        # In this order: what a level says before the run ends is still heard.
        while True:
            in_vain, tick = patience.is_in_vain, self._segment.words[System.TICK]
            told = answers.look()
            if told.fate not in ("given", "taken") or (told.fate == "taken" and not wait):
                return told
            if in_vain:
                raise Failure(f"{told.line}; the run ended")
            if told.fate == "given" and tick > last:
                raise Failure(
                    f"command {told.serial}: '{told.level}' has not answered in {ANSWER_CYCLES} of its cycles"
                )
            if time.monotonic() > deadline:
                still = f"in force until: {resume_command(self._segment.rack, told.level)}"
                raise Failure(f"timed out after {timeout_s:g} s: {told.line}, not done; {still}")
            if not patience.look_again():
                raise Failure(f"command {told.serial}: the clock has given out no tick for {SILENT_S:g} s")

    def _stands(self, level: str) -> str:
        """Return what an operator has a level do now; empty: its own work."""
        box = answering(self._segment, level)
        seen = open_observer(self._segment, box.name).peek() if box is not None else None
        if seen is None or not seen.is_there or not seen.value.standing:
            return ""
        return Operation(seen.value.standing).name.lower()
