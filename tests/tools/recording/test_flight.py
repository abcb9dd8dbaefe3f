"""The flight recorder: its folder stays small, and all required rows are kept.

Required are the last stretch and the time around each occasion.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config import RackConfig, load
from rack.tools.commands.record import save_run
from rack.tools.commands.replay import replay
from rack.tools.console.answer import Failure
from rack.tools.launch.launch import RunResult, run_rack
from rack.tools.monitor.display import Display
from rack.tools.monitor.snapshot import Snapshot
from rack.tools.recording.divergence import find_first_difference
from rack.tools.recording.file_names import CONFIG, SPOOL
from rack.tools.recording.occasions import Retention
from rack.tools.recording.recorder.recorder import Recorder
from rack.tools.recording.recording import Recording
from rack.tools.recording.run_files import count_spool, find_missing
from rack.tools.recording.spool import STRETCHES
from rack.tools.report.report import write_report
from rack.tools.viewer.parts import FILE
from rack.tools.viewer.reading import read_component
from tests.conftest import SMALL
from tests.tools.recording.struck_recorders import Held

pytestmark = pytest.mark.thorough

SECOND = 400
"""Ticks."""
KEEP_S, AROUND_S = 4, 1
RECORD = f'record={{ keep = "{KEEP_S} s", before = "{AROUND_S} s", after = "{AROUND_S} s" }}'
FAULT_S = 20
FAULT = f"fault=[{{ kind = 'drop', board = 'lower', at = {FAULT_S}.0, for = '0.1s' }}]"
LONG_S = 60.0
LEEWAY = 4
"""Stretches that are not whole seconds, and those at the borders."""


class StretchCounter(Display):
    """Counts the stretches in a folder, second by second."""

    period_s = 0.05

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.counts: dict[int, int] = {}

    def show(self, snapshot: Snapshot) -> None:
        """Count."""
        stretches = len([*(self.folder / STRETCHES).glob("*")])
        self.counts[snapshot.tick // SECOND] = stretches


@pytest.fixture
def config(small: Path, rack_name: str) -> RackConfig:
    """A rack of two levels that count, with a flight recorder and a fault."""
    return load(small, [f"name={rack_name}", RECORD, FAULT])


@pytest.fixture(scope="module")
def long_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunResult, StretchCounter]:
    """A run of one minute: its result, and the number of stretches in each second."""
    folder = tmp_path_factory.mktemp("flight")
    (folder / "small.toml").write_text(SMALL)
    config = load(folder / "small.toml", [f"name=test-flight-{os.getpid()}", RECORD, FAULT])
    display = StretchCounter(folder / "run")
    return run_rack(config, LONG_S, folder / "run", display), display


def test_a_long_run_does_not_grow_and_keeps_the_time_around_a_fault(
    long_run: tuple[RunResult, StretchCounter],
) -> None:
    result, display = long_run
    folder = display.folder
    assert (result.worked, result.recording) == (True, "complete")
    late = {second: count for second, count in display.counts.items() if second > 2 * KEEP_S}
    # The end of the fault, and the miss that its reader detected, are occasions as well.
    assert max(late.values()) <= KEEP_S + 2 * AROUND_S + 1 + LEEWAY
    assert max(late.values(), default=0) > KEEP_S - LEEWAY
    recording = Recording(folder)
    assert not (folder / STRETCHES).exists()
    around, last = recording.kept
    ticks = recording.read_trace("lower")["tick"]
    for first, end in (
        ((FAULT_S - AROUND_S) * SECOND, (FAULT_S + AROUND_S) * SECOND),
        (result.outcome.ticks - KEEP_S * SECOND, result.outcome.ticks),
    ):
        assert np.isin(np.arange(first, end), ticks).all()
        assert any(begin <= first and end <= until for begin, until in (around, last))
    assert len(ticks) < (KEEP_S + 2 * AROUND_S + LEEWAY) * SECOND
    assert not any(recording.lost_rows.values())
    assert recording.find_gaps() == []


def test_removed_stretches_count_neither_as_lost_nor_as_gaps(
    long_run: tuple[RunResult, StretchCounter], tmp_path: Path
) -> None:
    folder, made = long_run[1].folder, tmp_path / "made.rrd"
    report, text = write_report(folder)
    recording = Recording(folder)
    assert recording.kept_text.startswith("kept ")
    assert recording.kept_text.endswith("; the rest was not kept, as [record] keep says")
    assert report["kept"] == recording.kept_text
    assert f"- recording: {recording.kept_text}\n" in text
    assert (report["rows_lost"], report["gaps"], report["untraced"]) == ({}, [], {})
    # Ages must not span the removed stretch.
    assert report["tasks"]["lower"]["plan_age_ms"]["max"] < 100
    with pytest.raises(Failure, match=r"the rest was not kept.*cannot be compared"):
        find_first_difference(recording, recording)
    assert not (folder / FILE).exists()
    replay([folder], made, against=None)
    shown = read_component(made, "/signals/lower.status/count")
    assert shown.ticks.tolist() == recording.read_signal("lower.status", "tick").tolist()
    # The viewer must not show an age where nothing was kept.
    ages = read_component(made, "/ages/lower.status").ticks
    assert len(ages)
    (_, gone), (back, _) = recording.kept
    assert not ((ages > gone + SECOND) & (ages < back - SECOND)).any()
    logged = RrdReader(str(made)).stream().filter(content="/log/recorder").to_chunks()
    assert recording.kept_text in str([chunk.to_record_batch().to_pydict() for chunk in logged])


def test_a_restarted_flight_recorder_continues_with_the_next_stretch(
    config: RackConfig, tmp_path: Path
) -> None:
    display = Held(config.name, signal.SIGKILL, tick=25 * SECOND)
    result = run_rack(config, LONG_S, tmp_path / "run", display, step=True)
    assert display.struck
    assert (result.worked, result.recording) == (True, "complete")
    recording = Recording(tmp_path / "run")
    ticks = recording.read_trace("lower")["tick"]
    # Stretches that the first recorder had not removed are kept.
    assert np.isin(np.arange((FAULT_S - AROUND_S) * SECOND, 25 * SECOND), ticks).all()
    assert not any(recording.lost_rows.values())


def record_flight(rack: Rack, folder: Path, seconds: float) -> Recorder:
    """Run a rack and record it in this process. Returns the recorder, which is still open."""
    folder.mkdir()
    (folder / CONFIG).write_text(rack.config.to_toml_text())
    recorder = Recorder(rack.segment, folder)
    rack.start(seconds)
    while rack.watch(0.002):
        recorder.drain_rings()
    recorder.drain_rings()
    return recorder


def find_missing_rows(segment: Segment, folder: Path) -> tuple[set[str], list[tuple[int, int]]]:
    """Return the rings with missing rows, and the required ticks that were not kept."""
    left, keeping = count_spool(folder), Retention.from_config(segment)
    assert left is not None
    assert keeping is not None
    absent = keeping.find_missing_windows(segment, left.kept, segment.words[System.STOP_TICK])
    return {*find_missing(segment, left.taken, left.lost)}, [tuple(ends) for ends in absent]


def test_a_recording_is_complete_only_if_every_required_tick_is_kept(
    config: RackConfig, tmp_path: Path
) -> None:
    early = config.model_copy(
        update={"fault": tuple(fault.model_copy(update={"at": 2.0}) for fault in config.fault)}
    )
    folder = tmp_path / "run"
    with Rack(early) as rack:
        segment = rack.segment
        nothing = tmp_path / "nothing"
        nothing.mkdir()
        Recorder(segment, nothing).close()
        record_flight(rack, folder, seconds=10.0).close()
        assert find_missing_rows(segment, folder) == (set(), [])
        stretches = sorted((folder / STRETCHES).iterdir())
        # The last two stretches begin when the run ends, and may hold no rows.
        around, last = stretches[1], stretches[-3]
        for path in (around, last):
            whole = path.read_bytes()
            path.unlink()
            lacking, absent = find_missing_rows(segment, folder)
            # A deleted stretch is no damage, but it counts as removed although it was required.
            assert not lacking
            assert absent
            path.write_bytes(whole)
        whole = last.read_bytes()
        last.write_bytes(whole[: len(whole) * 2 // 3])
        lacking, absent = find_missing_rows(segment, folder)
        assert lacking
        assert not absent
        lacking, absent = find_missing_rows(segment, nothing)
    assert {"lower", "lower.status", "upper"} <= lacking
    assert absent


def test_kept_stretches_can_be_saved_during_the_run(config: RackConfig, tmp_path: Path) -> None:
    run, saved = tmp_path / "run", tmp_path / "saved"
    with Rack(config) as rack:
        recorder = record_flight(rack, run, seconds=6.0)
        left = sorted(path.name for path in (run / STRETCHES).iterdir())
        save_run(run, saved)
        recorder.close()
        assert left[:3] == sorted(path.name for path in (run / STRETCHES).iterdir())[:3]
    part, whole = Recording(saved), Recording(run)
    assert not (saved / SPOOL).exists()
    assert not (saved / STRETCHES).exists()
    ticks = part.read_trace("lower")["tick"]
    assert len(ticks) > SECOND
    assert np.isin(ticks, whole.read_trace("lower")["tick"]).all()
