"""Recordings that fail: the run continues, what was written stays readable, and the user gets a message."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from rerun.chunk import RrdReader

from rack.boards import Rack
from rack.boards.config import RackConfig, load
from rack.boards.events import Event
from rack.tools.analysis.report import write_report
from rack.tools.console.answer import Failure
from rack.tools.recorder.recorder import Recorder, SafeSink
from rack.tools.runs import recorder_process
from rack.tools.runs.display import Display
from rack.tools.runs.launch import NO_RECORDER, run_rack
from rack.tools.runs.recording import Recording
from rack.tools.runs.snapshot import Snapshot
from rack.tools.runs.spool import SPOOL, mend
from rack.tools.runs.window import executable
from rack.tools.viewer.reading import read
from tests.processes import children_of
from tests.shared_runs import small_run

WATCHDOG_S = 30.0
FIRST_BLOCK = 400
"""Ticks after which there is something on disk."""
LONG_S = 12.0
"""Simulated time that the recorder does not outrun."""


@pytest.fixture
def config(small: Path, rack_name: str) -> RackConfig:
    """A rack of two levels that count, without an arm."""
    return load(small, [f"name={rack_name}"])


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


def test_a_recorder_in_a_hurry_does_without_a_sink_that_is_not_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rack.tools.recorder.recorder.HURRIED_S", 0.05)
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


def test_a_sink_that_cannot_be_opened_is_reported_once() -> None:
    notes: list[str] = []

    def opened() -> Taking:
        raise ImportError("no viewer here")

    safe = SafeSink(opened, notes.append)
    safe.add("servo", np.zeros(1))
    safe.close(1, {})
    assert notes == ["run.rrd ends here: no viewer here"]


def test_a_rack_without_an_arm_is_recorded_too(tmp_path_factory: pytest.TempPathFactory) -> None:
    recording = Recording(small_run(tmp_path_factory))
    for field, mailbox in (("count", "lower.status"), ("goal", "upper.command")):
        rows = read(recording.folder / "run.rrd", f"/signals/{mailbox}/{field}")
        assert np.array_equal(rows.values.ravel(), recording.signal(mailbox, field))
        assert np.array_equal(rows.ticks, recording.signal(mailbox, "tick"))


def test_a_full_disk_ends_the_view_and_nothing_else(config: RackConfig, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "run.rrd").symlink_to("/dev/full")
    result = run_rack(config, 5.0, folder, Display())
    recording = Recording(folder)
    assert result.worked
    assert result.recording == "complete"
    assert len(recording.cycles["lower"]) == 2000
    lines = [event["text"] for event in recording.events if event["kind"] == "recorder"]
    assert len(lines) == 1
    assert lines[0].startswith("run.rrd ends here: ")


class Keeping(Display):
    """Keeps the texts of events."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def show_event(self, event: Event) -> None:
        """Keep the text."""
        self.texts.append(event.text)


def test_a_full_disk_under_the_events_ends_no_run(config: RackConfig, tmp_path: Path) -> None:
    folder, display = tmp_path / "run", Keeping()
    folder.mkdir()
    (folder / "events.jsonl").symlink_to("/dev/full")
    assert run_rack(config, 0.5, folder, display).worked
    assert display.texts.count("events.jsonl ends here: No space left on device") == 1


class AtTick(Display):
    """Sends a signal to the recorder of the run, once, when that has got to some tick."""

    period_s = 0.05

    def __init__(self, number: signal.Signals, tick: int = FIRST_BLOCK, view: Path | None = None) -> None:
        self._number, self._tick, self._view = number, tick, view
        self._view_began = 0
        self.struck: list[int] = []

    def _has_view(self) -> bool:
        """Say whether the viewer's file, if that matters, has grown since it was begun."""
        if self._view is None:
            return True
        size = self._view.stat().st_size if self._view.is_file() else 0
        self._view_began = self._view_began or size
        return size > self._view_began > 0

    def show(self, snapshot: Snapshot) -> None:
        """Look at the tick, and at the viewer's file."""
        if snapshot.tick > self._tick and not self.struck and self._has_view():
            self.struck = [pid for pid in children_of(os.getpid()) if b"rack.tools.recorder" in command_of(pid)]
            os.kill(self.struck[0], self._number)


def command_of(pid: int) -> bytes:
    return Path(f"/proc/{pid}/cmdline").read_bytes()


def notes_of(recording: Recording) -> list[str]:
    return [event["text"] for event in recording.events if event["kind"] == "recorder"]


def realtime(config: RackConfig) -> RackConfig:
    return config.model_copy(update={"clock": config.clock.model_copy(update={"mode": "realtime"})})


def test_a_recorder_that_is_killed_is_restarted_and_goes_on_where_it_was(config: RackConfig, tmp_path: Path) -> None:
    display = AtTick(signal.SIGKILL)
    result = run_rack(config, LONG_S, tmp_path / "run", display)
    assert display.struck
    assert (result.worked, result.recording) == (True, "complete")
    recording = Recording(tmp_path / "run")
    assert notes_of(recording)[0] == "the recorder ended with status -9; restarted, 1 of at most 3 times"
    # In lockstep the clock waits for the next one as it did for the first: not one row is missing.
    serials = recording.signal("lower.status", "serial")
    assert np.array_equal(serials, np.arange(1, result.outcome.ticks + 1))
    assert len(recording.cycles["lower"]) == result.outcome.ticks
    assert not any(recording.lost.values())
    assert result.outcome.digest == run_rack(config, LONG_S, None, Display()).outcome.digest
    # The viewer's file is not written over.
    assert {"run.rrd", "run-2.rrd"} < {path.name for path in (tmp_path / "run").iterdir()}


def test_what_a_killed_recorder_took_is_readable(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_process, "RESTARTS", 0)
    display = AtTick(signal.SIGKILL, view=tmp_path / "run" / "run.rrd")
    result = run_rack(realtime(config), LONG_S, tmp_path / "run", display)
    assert result.worked
    assert result.recording == "the recorder ended with status -9"
    report, _ = write_report(tmp_path / "run")
    assert report["worked"]
    assert notes_of(Recording(tmp_path / "run")) == ["the recorder ended with status -9; the run continues, unrecorded"]
    ticks = pq.read_table(tmp_path / "run" / "signals.parquet", columns=["tick"])["tick"].to_numpy()
    assert ticks.max() > FIRST_BLOCK / 2
    repaired = tmp_path / "repaired.rrd"
    for command in (["optimize", tmp_path / "run" / "run.rrd", "-o", repaired], ["verify", repaired]):
        subprocess.run([executable(), "rrd", *command], check=True, capture_output=True, timeout=WATCHDOG_S)
    assert RrdReader(str(repaired)).stream().filter(content="/boards/**").to_chunks()


def test_a_recorder_that_is_stopped_delays_no_end(config: RackConfig, tmp_path: Path) -> None:
    result = run_rack(realtime(config), 2.0, tmp_path / "run", AtTick(signal.SIGSTOP))
    assert result.worked
    assert result.recording == "the recorder ended with status -9"
    assert Recording(tmp_path / "run").signal("lower.status", "tick")[-1] > FIRST_BLOCK / 2


def test_a_recorder_that_comes_late_delays_no_run(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_process, "ATTACH_S", 0.0)
    result = run_rack(realtime(config), 3.0, tmp_path / "run", Display())
    assert (result.worked, result.recording) == (True, "complete")
    assert notes_of(Recording(tmp_path / "run"))[:1] == [NO_RECORDER]


def test_two_recorders_do_not_write_into_one_folder(config: RackConfig, tmp_path: Path) -> None:
    with Rack(config) as rack, Recorder(rack.segment, tmp_path):
        with pytest.raises(Failure, match="another recorder is running there"):
            Recorder(rack.segment, tmp_path)
        with pytest.raises(Failure, match="another recorder is running there"):
            mend(tmp_path)


def test_a_spool_that_is_cut_anywhere_gives_what_is_whole(config: RackConfig, tmp_path: Path) -> None:
    with Rack(config) as rack, Recorder(rack.segment, tmp_path) as recorder:
        rack.run(0.5)
        recorder.drain()
        whole = (tmp_path / SPOOL).read_bytes()
    found = []
    for size in (len(whole), len(whole) - 1, len(whole) * 2 // 3, len(whole) // 2):
        folder = tmp_path / str(size)
        folder.mkdir()
        (folder / SPOOL).write_bytes(whole[:size])
        assert mend(folder)
        found.append(pq.read_metadata(folder / "signals.parquet").num_rows)
    assert found == sorted(found, reverse=True)
    assert found[0] > 200 > found[-1]
