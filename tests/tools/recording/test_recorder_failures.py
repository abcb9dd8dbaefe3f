"""Recorders that are killed, stopped or late.

The run continues, recorded rows stay readable, and the user gets a message.
"""

from __future__ import annotations

import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from rack.backplane.segment import Launch
from rack.backplane.trace import RECORD
from rack.boards import Rack
from rack.boards.config import RackConfig, load, resolve_layout
from rack.tools.console.answer import Failure
from rack.tools.launch.launch import NO_RECORDER, run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.file_names import CONFIG, SPOOL
from rack.tools.recording.recorder import process as recorder_process
from rack.tools.recording.recorder.recorder import Recorder
from rack.tools.recording.recording import Recording
from rack.tools.recording.run_files import rebuild_files
from rack.tools.recording.spool import Spool, try_lock
from rack.tools.report.analysis import Analysis
from rack.tools.report.report import write_report
from tests.tools.analysis_text import text as analysis_text
from tests.tools.recording.struck_recorders import (
    LONG_S,
    AtTick,
    Held,
    counts,
    has_spooled,
    notes_of,
    realtime,
)

pytestmark = pytest.mark.thorough

WATCHDOG_S = 60.0


def test_a_killed_recorder_is_restarted_and_continues_where_it_stopped(
    config: RackConfig, tmp_path: Path
) -> None:
    # The viewer's library takes its time to open its file.
    has_view = (tmp_path / "run" / "run.rrd").is_file
    display = Held(config.name, signal.SIGKILL, is_ready=has_view)
    result = run_rack(config, LONG_S / 2, tmp_path / "run", display, step=True)
    assert display.struck
    assert (result.worked, result.recording) == (True, "complete")
    recording = Recording(tmp_path / "run")
    restarted = "the recorder ended with status -9; restarted, 1 of at most 3 times"
    assert notes_of(recording)[0] == restarted
    # In lockstep the clock waits for the next recorder as for the first, so no row is missing.
    serials = recording.read_signal("lower.status", "serial")
    assert np.array_equal(serials, np.arange(1, result.outcome.ticks + 1))
    assert not any(recording.lost_rows.values())
    whole = run_rack(config, LONG_S / 2, tmp_path / "whole", Display())
    assert result.outcome.digest == whole.outcome.digest
    assert counts(recording) == counts(Recording(tmp_path / "whole"))
    # The viewer's file is not overwritten.
    assert {"run.rrd", "run-2.rrd"} < {path.name for path in (tmp_path / "run").iterdir()}


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_stopped_recorder_is_replaced_without_losing_rows(
    config: RackConfig, tmp_path: Path, mode: str
) -> None:
    display: AtTick = Held(config.name, signal.SIGSTOP)
    if mode == "realtime":
        # The rings hold two seconds, which is the whole run. It is slow, so that the display comes
        # to look before its end.
        display, config = AtTick(signal.SIGSTOP), realtime(config, speed=0.25)
    seconds = LONG_S / 2 if mode == "lockstep" else 2.0
    result = run_rack(config, seconds, tmp_path / "run", display, step=mode == "lockstep")
    assert display.struck
    assert (result.worked, result.recording) == (True, "complete")
    recording = Recording(tmp_path / "run")
    assert notes_of(recording)[0] == "the recorder did not respond and was killed"
    rows = len(recording.read_signal("lower.status", "serial"))
    assert rows == result.outcome.ticks or mode == "realtime"


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_lockstep_waits_for_a_late_recorder_and_real_time_does_not(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    monkeypatch.setattr(recorder_process, "ATTACH_S", 0.0)
    # The rings hold two seconds, which is the whole run, however late the recorder is.
    seconds, config = (3.0, config) if mode == "lockstep" else (1.5, realtime(config))
    result = run_rack(config, seconds, tmp_path / "run", Display())
    assert (result.worked, result.recording) == (True, "complete")
    notes = notes_of(Recording(tmp_path / "run"))
    assert notes[0] == NO_RECORDER
    assert mode == "realtime" or notes[1] == "the recorder has begun"


@pytest.mark.parametrize(
    ("fault", "board"),
    [
        ("kind = 'drop', at = 0.4, for = '0.4s'", "lower"),
        ("kind = 'masquerade', at = 0.4", "lower"),
        # Each cycle sends as many messages as the ring of a slow task holds for a second.
        ("kind = 'babble', at = 0.4, for = '1s', writes = 25", "upper"),
    ],
    ids=["drop", "masquerade", "babble"],
)
def test_no_message_is_missing_or_repeated_despite_damage_and_a_killed_recorder(
    small: Path, rack_name: str, fault: str, board: str
) -> None:
    faults = f"fault=[{{ {fault}, board = '{board}' }}]"
    folder = small.parent / "run"
    config, display = load(small, [f"name={rack_name}", faults]), Held(rack_name, signal.SIGKILL)
    result = run_rack(config, LONG_S / 2, folder, display, step=True)
    assert display.struck
    assert result.faults[0].count >= 1
    assert result.recording == "complete"
    serials = Recording(folder).read_signal("lower.status", "serial")
    assert np.all(np.diff(serials) > 0)


def test_a_run_whose_recorder_dies_too_often_fails_and_reports_missing_rows(
    config: RackConfig, tmp_path: Path
) -> None:
    times, run = recorder_process.MAX_RESTARTS + 1, tmp_path / "run"
    display = Held(config.name, signal.SIGKILL, times=times, is_ready=lambda: has_spooled(run, 1))
    result = run_rack(config, LONG_S, run, display, step=True)
    assert len(display.struck) == times
    assert (result.outcome.is_success, result.worked) == (True, False)
    recording, ticks = Recording(tmp_path / "run"), result.outcome.ticks
    taken = counts(recording)
    missing = {name: ticks - taken[name] for name in ("lower", "lower.status")}
    assert missing["lower"] > ticks / 4
    assert missing.items() <= result.rows_lost.items()
    assert missing.items() <= recording.lost_rows.items()
    worst = max(result.rows_lost, key=lambda name: (result.rows_lost[name], name))
    (gap,) = recording.find_gaps()
    # Slow rings lack the rows after their last message.
    assert (gap.first <= taken["lower"], gap.last) == (True, ticks - 1)
    assert set(gap.rings) == set(result.rows_lost)
    others = f"and rows of {len(result.rows_lost) - 1} more tasks and mailboxes"
    lacking = f"{missing['lower']:,} of {ticks:,} rows of {worst} are missing ({others})"
    assert result.recording == f"{lacking}; {gap}; the recorder ended with status -9"
    report, text = write_report(tmp_path / "run")
    assert report["failures"][-1].endswith(result.recording)
    assert f"Times of lower are from {taken['lower']:,} of {ticks:,} cycles." in text
    assert str(gap) in text
    assert report["gaps"] == [{"first": gap.first, "last": gap.last, "rings": gap.rings}]
    # One line names all that is missing.
    lines = analysis_text(Analysis.from_recording(recording)).splitlines()
    (line,) = (line for line in lines if str(gap) in line)
    assert f"lower is judged by {taken['lower']:,} of {ticks:,} cycles" in line


def test_a_recorder_that_dies_while_writing_the_viewers_file_is_reported(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        recorder_process, "VIEW_CLASS", "tests.tools.recording.struck_recorders:EndingView"
    )
    result = run_rack(config, 1.0, tmp_path / "run", Display())
    # Its tables were complete before.
    assert (result.worked, result.recording) == (True, "complete")
    assert notes_of(Recording(tmp_path / "run")) == [
        "the recorder ended with status 70; run.rrd may lack its end"
    ]


def test_two_recorders_do_not_write_into_one_folder(config: RackConfig, tmp_path: Path) -> None:
    with Rack(config) as rack, Recorder(rack.segment, tmp_path):
        with pytest.raises(Failure, match="another recorder is still writing it"):
            Recorder(rack.segment, tmp_path)
        with pytest.raises(Failure, match="another recorder is still writing it"):
            rebuild_files(tmp_path)


def test_opening_a_run_waits_for_the_recorder_of_a_killed_launcher(
    config: RackConfig, tmp_path: Path
) -> None:
    (tmp_path / CONFIG).write_text(config.to_toml_text())
    with Rack(config) as rack, ThreadPoolExecutor(1) as pool:
        recorder = Recorder(rack.segment, tmp_path)
        rack.run(0.5)
        opened = pool.submit(Recording, tmp_path)
        with pytest.raises(TimeoutError):
            opened.result(3 * recorder_process.CHECK_PERIOD_S)
        recorder.drain_rings()
        recorder.close()
        assert len(opened.result(WATCHDOG_S).read_trace("lower")) == 200
    assert not (tmp_path / SPOOL).exists()


def test_a_truncated_spool_yields_all_complete_lines(config: RackConfig, tmp_path: Path) -> None:
    with Rack(config) as rack, Recorder(rack.segment, tmp_path) as recorder:
        rack.run(0.5)
        recorder.drain_rings()
        whole = (tmp_path / SPOOL).read_bytes()
    found = []
    for size in (len(whole), len(whole) - 1, len(whole) * 2 // 3, len(whole) // 2):
        folder = tmp_path / str(size)
        folder.mkdir()
        (folder / SPOOL).write_bytes(whole[:size])
        assert rebuild_files(folder)
        tables = (folder / "signals").iterdir()
        found.append(sum(pq.read_table(table).num_rows for table in tables))
    assert found == sorted(found, reverse=True)
    assert found[0] > 200 > found[-1]


def test_a_spool_is_locked_until_the_files_built_from_it_are_in_place(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the lock, two programs that open a killed recorder's run at once would damage it."""
    with Rack(config) as rack:
        Recorder(rack.segment, tmp_path)._spool.close()
    refused = []

    def store(checksums: Checksums, *patterns: str) -> None:
        with (tmp_path / SPOOL).open("rb") as spool:
            refused.append(not try_lock(spool))

    monkeypatch.setattr(Checksums, "store", store)
    assert rebuild_files(tmp_path)
    assert refused == [True]


def test_a_gap_keeps_its_position_when_files_are_rebuilt(
    config: RackConfig, tmp_path: Path
) -> None:
    (tmp_path / CONFIG).write_text(config.to_toml_text())
    rows = np.zeros(300, dtype=RECORD)
    rows["tick"] = np.arange(300)
    spool = Spool(tmp_path, resolve_layout(config), Launch(*range(1, 1 + len(Launch._fields))))
    spool.add_rows("lower", rows[:100], 0)
    spool.flush(now=True)
    # One flush writes two drains, with rows lost between them.
    spool.add_rows("lower", rows[100:120], 0)
    spool.add_rows("lower", rows[220:], 100)
    spool.flush(now=True)
    spool.close()
    assert [str(gap) for gap in Recording(tmp_path).find_gaps()] == [
        "ticks 120 to 219 of lower are not recorded"
    ]
