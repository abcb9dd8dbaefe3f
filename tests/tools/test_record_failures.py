"""A recording that cannot go on: the rack does, what was written stays readable, and the user is told."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from backplane.words import System
from boards.config import RackConfig, load
from boards.rack import Rack
from tools.display import SilentDisplay
from tools.recorder.process import RecorderProcess
from tools.recorder.side_sink import SideSink
from tools.recording import Recording
from tools.running import run_rack
from tools.viewer.reading import read
from tools.viewer.window import executable

WATCHDOG_S = 30.0
TWO_BLOCKS = 1000


@pytest.fixture
def config(small: Path, rack_name: str) -> RackConfig:
    """A rack of two levels that count, without an arm."""
    return load(small, [f"name={rack_name}"])


class Failing:
    """A sink that fails at the second block."""

    def __init__(self) -> None:
        self.blocks = 0

    def add_cycles(self, task: str, rows: np.ndarray) -> None:
        """Take anything."""

    def add_signals(self, mailbox: str, rows: np.ndarray) -> None:
        """Take anything."""

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Fail once there was one block."""
        self.blocks += 1
        if self.blocks > 1:
            raise RuntimeError("the disk\nis full")

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """Never come here."""
        raise AssertionError("a sink that failed is not asked again")


def test_a_sink_that_fails_is_told_of_once_and_left_alone() -> None:
    told: list[str] = []
    sink = Failing()
    beside = SideSink(lambda: sink, told.append)
    for tick in range(5):
        beside.add_cycles("servo", np.zeros(1))
        beside.advance(tick, {})
    beside.close(5, {})
    assert told == ["run.rrd ends here: the disk is full"]
    assert sink.blocks == 2


def test_a_rack_without_an_arm_is_recorded_too(config: RackConfig, tmp_path: Path) -> None:
    run_rack(config, 3.0, tmp_path / "run", SilentDisplay())
    recording = Recording(tmp_path / "run")
    for field, mailbox in (("count", "lower.status"), ("goal", "upper.command")):
        rows = read(tmp_path / "run" / "run.rrd", f"/signals/{mailbox}/{field}")
        assert np.array_equal(rows.values.ravel(), recording.signal(mailbox, field))
        assert np.array_equal(rows.ticks, recording.signal(mailbox, "tick"))


def test_a_full_disk_ends_the_view_and_nothing_else(config: RackConfig, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "run.rrd").symlink_to("/dev/full")
    result = run_rack(config, 5.0, folder, SilentDisplay())
    recording = Recording(folder)
    assert result.worked
    assert result.recording == "complete"
    assert len(recording.cycles["lower"]) == 2000
    told = [event["text"] for event in recording.events if event["kind"] == "recorder"]
    assert len(told) == 1
    assert told[0].startswith("run.rrd ends here: ")


def test_a_recorder_that_is_killed_leaves_a_readable_file_and_a_running_rack(
    config: RackConfig, tmp_path: Path
) -> None:
    realtime = config.model_copy(update={"clock": config.clock.model_copy(update={"mode": "realtime"})})
    recorder = RecorderProcess()
    with Rack(realtime) as rack:
        assert recorder.attach(rack.config.name, tmp_path)
        rack.start(seconds=4.0)
        _until(lambda: rack.segment.words[System.TICK] > TWO_BLOCKS, rack)
        os.kill(recorder.pid, signal.SIGKILL)
        told: list[str] = []
        _until(lambda: bool(told) or bool(told.extend(recorder.told())), rack)
        while rack.watch(0.5):
            continue
    assert "status -9" in told[0]
    assert recorder.told() == []
    assert rack.outcome is not None
    assert rack.outcome.worked
    assert "status -9" in recorder.finish()
    repaired = tmp_path / "repaired.rrd"
    for command in (["optimize", tmp_path / "run.rrd", "-o", repaired], ["verify", repaired]):
        subprocess.run([executable(), "rrd", *command], check=True, capture_output=True, timeout=WATCHDOG_S)
    assert RrdReader(str(repaired)).stream().filter(content="/boards/**").to_chunks()


def _until(done: Callable[[], bool], rack: Rack) -> None:
    """Watch the rack until something is so, by a watchdog's patience."""
    deadline = time.monotonic() + WATCHDOG_S
    while not done():
        assert time.monotonic() < deadline
        rack.watch(0.05)
