"""Waits during a launch: their time limits, what is said of them, and what the crate answers."""

from __future__ import annotations

from collections import deque
from typing import cast

import pytest

from rack.backplane.segment import Segment
from rack.boards.crate import patience
from rack.boards.crate.line import CrateLine
from rack.boards.crate.patience import (
    COMPILE_S,
    PATIENCE_S,
    PeerWaitReporter,
    ReportedWait,
    await_open_segment,
)
from rack.boards.crate.requests import Compiling, Opened, PreloadFailed, Preloading
from rack.boards.errors import LaunchError
from rack.boards.events import Journal
from tests.boards.crate.test_heartbeat import Clock

LIMIT_S = 60.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(patience, "time", made)
    return made


def said(journal: Journal) -> list[str]:
    assert {event.kind for event in journal.events} <= {"waiting"}
    return [event.text for event in journal.events]


def test_a_wait_is_reported_each_time_it_has_doubled(clock: Clock) -> None:
    journal = Journal(None)
    wait = ReportedWait(journal, LIMIT_S)
    assert wait.left_s == PATIENCE_S
    for passed in (1.9, 2.0, 2.1, 3.9, 4.0, 7.9, 8.1):
        clock.now_s = 100.0 + passed
        wait.report_if_due("loading")
    assert said(journal) == [f"loading, {seconds} s so far" for seconds in (2, 4, 8)]
    assert wait.left_s == pytest.approx(16.0 - 8.1)


class Line:
    """A crate that answers at its times; each wait for it moves the clock on."""

    def __init__(self, clock: Clock, *answers: tuple[float, object]) -> None:
        self._clock = clock
        self._answers = deque(answers)
        self.line = self
        self.output: list[str] = []

    def poll(self, timeout_s: float) -> bool:
        if self._answers and self._answers[0][0] <= self._clock.now_s - 100.0 + timeout_s:
            self._clock.now_s = max(self._clock.now_s, 100.0 + self._answers[0][0])
            return True
        self._clock.now_s += timeout_s + 0.001
        return False

    def receive_message(self) -> object:
        return self._answers.popleft()[1]

    def read_output(self) -> list[str]:
        return self.output

    build_error = CrateLine.build_error


def opened(clock: Clock, *answers: tuple[float, object], output: str = "") -> tuple[list[str], str]:
    """Wait for a crate with these answers; return what was said, and why it failed."""
    journal = Journal(None)
    line = Line(clock, *answers)
    line.output = output.split("\n") if output else []
    why = ""
    try:
        await_open_segment(cast(CrateLine, line), journal, LIMIT_S)
    except LaunchError as error:
        why = str(error)
    return said(journal), why


def test_each_class_has_its_own_time_limit_and_compiling_a_longer_one(clock: Clock) -> None:
    lines, why = opened(clock, (50.0, Preloading("a:B")), (105.0, Opened(-1)))
    assert why == ""
    assert lines[0] == "the crate is starting, 2 s so far"
    assert lines[-1] == "preloading 'a:B', 32 s so far"
    lines, why = opened(clock, (0.0, Compiling("terms")), (COMPILE_S - 1.0, Opened(-1)))
    assert why == ""
    assert lines[0] == "compiling 'terms', which is kept for later launches, 2 s so far"


def test_a_crate_that_does_not_open_is_reported_with_its_activity(clock: Clock) -> None:
    assert opened(clock)[1] == "the crate is starting: not done within 60 s"
    assert opened(clock, (0.0, Preloading("a:B")))[1] == "preloading 'a:B': not done within 60 s"
    why = opened(clock, (0.0, Compiling("terms")))[1]
    assert why == "compiling 'terms', which is kept for later launches: not done within 300 s"
    assert opened(clock, output="one\ntwo")[1] == "one\ntwo"


def test_a_crate_that_fails_or_ends_is_reported_with_the_reason(clock: Clock) -> None:
    failed = PreloadFailed("a:B", "no such file")
    assert opened(clock, (0.0, failed))[1] == "'a:B' cannot be preloaded: no such file"
    assert opened(clock, (0.0, None))[1] == "the crate has ended"
    assert opened(clock, (0.0, None), output="killed")[1] == "killed"


def test_a_wait_for_another_rack_is_reported_each_time_it_has_doubled(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits = [("lan", "waits for rack 'b'")]
    monkeypatch.setattr(patience, "find_waits", lambda segment: iter(waits))
    journal = Journal(None)
    rack = PeerWaitReporter(cast("Segment", None), journal)
    for passed in (0.0, 1.9, 2.1, 4.1):
        clock.now_s = 100.0 + passed
        rack.report_if_due()
    assert said(journal) == [f"'lan' waits for rack 'b', {s} s so far" for s in (2, 4)]
    waits.clear()
    rack.report_if_due()
    waits.append(("lan", "waits for rack 'c'"))
    rack.report_if_due()
    clock.now_s += 2.1
    rack.report_if_due()
    assert said(journal)[2:] == ["'lan' waits for rack 'c', 2 s so far"]
