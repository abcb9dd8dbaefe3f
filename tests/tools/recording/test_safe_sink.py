"""A sink that fails, or takes long to open: the recorder goes on, and the user gets one message."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from rack.boards import Rack
from rack.boards.config import load
from rack.tools.recording.recorder.recorder import SafeSink, is_opening

WATCHDOG_S = 30.0


class Failing:
    """A sink that fails at the second block."""

    def __init__(self) -> None:
        self.blocks = 0

    def add(self, ring: str, rows: np.ndarray) -> None:
        """Take anything."""

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Fail once there was one block."""
        self.blocks += 1
        if self.blocks > 1:
            raise RuntimeError("the disk\nis full")

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """Never come here."""
        raise AssertionError("a sink that failed is not asked again")


def test_a_sink_that_fails_is_reported_once_and_not_called_again() -> None:
    notes: list[str] = []
    sink = Failing()
    safe = SafeSink(lambda: sink, notes.append)
    for tick in range(5):
        safe.add("servo", np.zeros(1))
        safe.advance(tick, {})
    safe.close(5, {})
    assert notes == ["run.rrd ends here: the disk is full"]
    assert sink.blocks == 2


class Taking:
    """A sink that takes everything, and keeps the calls."""

    def __init__(self) -> None:
        self.calls: list[object] = []

    def add(self, ring: str, rows: np.ndarray) -> None:
        """Keep the rows."""
        self.calls.append((ring, rows.tolist()))

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Keep the tick."""
        self.calls.append(tick)

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """Keep the end."""
        self.calls.append("end")


def test_rows_wait_for_a_sink_that_takes_long_to_open() -> None:
    may_open, sink = threading.Event(), Taking()

    def opened() -> Taking:
        assert may_open.wait(WATCHDOG_S)
        return sink

    safe = SafeSink(opened, pytest.fail, in_background=True)
    for tick in range(3):
        safe.add("servo", np.array([tick]))
        safe.advance(tick, {})
    assert sink.calls == []
    may_open.set()
    safe.close(3, {})
    assert sink.calls == [("servo", [0]), 0, ("servo", [1]), 1, ("servo", [2]), 2, "end"]


def test_a_recorder_in_a_hurry_does_without_a_sink_that_is_not_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rack.tools.recording.recorder.recorder.HURRIED_S", 0.05)
    may_open, sink, notes = threading.Event(), Taking(), list[str]()

    def opened() -> Taking:
        assert may_open.wait(WATCHDOG_S)
        return sink

    safe = SafeSink(opened, notes.append, in_background=True)
    safe.add("servo", np.zeros(1))
    safe.hurry()
    safe.close(1, {})
    may_open.set()
    assert sink.calls == []
    assert len(notes) == 1
    assert notes[0].startswith("run.rrd is missing: ")


def test_a_recorder_does_not_wait_for_ever_for_a_sink_whose_opening_hangs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rack.tools.recording.recorder.recorder.OPENED_S", 0.05)
    may_open, notes = threading.Event(), list[str]()

    def opened() -> Taking:
        assert may_open.wait(WATCHDOG_S)
        return Taking()

    safe = SafeSink(opened, notes.append, in_background=True)
    safe.close(1, {})
    assert is_opening()
    may_open.set()
    why = "the viewer's library has not opened it; 'rack replay' makes it"
    assert notes == [f"run.rrd is missing: {why}"]


def test_a_sink_that_cannot_be_opened_is_reported_once() -> None:
    notes: list[str] = []

    def opened() -> Taking:
        raise ImportError("no viewer here")

    safe = SafeSink(opened, notes.append)
    safe.add("servo", np.zeros(1))
    safe.close(1, {})
    assert notes == ["run.rrd ends here: no viewer here"]


@pytest.mark.slow
def test_a_sink_whose_opening_uses_no_processor_time_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rack.tools.recording.recorder.recorder.LOOK_S", 0.02)
    may_open, notes = threading.Event(), list[str]()

    def opened() -> Taking:
        assert may_open.wait(WATCHDOG_S)
        return Taking()

    safe = SafeSink(opened, notes.append, in_background=True)
    safe.close(1, {})
    assert not may_open.is_set()
    may_open.set()
    assert len(notes) == 1
    assert notes[0].startswith("run.rrd is missing: ")


def test_neither_mode_waits_for_the_library_of_the_viewer(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    may_open = threading.Event()

    def opened() -> Taking:
        assert may_open.wait(WATCHDOG_S)
        return Taking()

    for mode in ("lockstep", "realtime"):
        config = load(small, [f"name={rack_name}", f"clock.mode={mode}"])
        with Rack(config) as running:
            assert SafeSink.of(running.segment, None, opened, pytest.fail) is not None
            assert is_opening()
    may_open.set()
