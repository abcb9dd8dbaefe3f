"""Recordings that fail: the run continues, what was written stays readable, and the user gets a
message."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from rerun.chunk import RrdReader

from rack.backplane.segment import Launch, Segment, racks
from rack.backplane.trace import RECORD
from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config import RackConfig, load, wire
from rack.boards.events import Event
from rack.tools.console.answer import Failure
from rack.tools.live.display import Display
from rack.tools.live.launch import NO_RECORDER, run_rack
from rack.tools.live.snapshot import Snapshot
from rack.tools.recording import recorder_process
from rack.tools.recording.parquet import CONFIG
from rack.tools.recording.recorder.recorder import Recorder, SafeSink
from rack.tools.recording.recorder_process import SPOOL
from rack.tools.recording.recording import Recording
from rack.tools.recording.run_files import mend
from rack.tools.recording.spool import Spool
from rack.tools.timing.analysis.analysis import Analysis
from rack.tools.timing.analysis.report import write_report
from rack.tools.timing.analysis.tables import text as analysis_text
from rack.tools.viewer.reading import read
from rack.tools.viewer.window import executable
from tests.processes import children_of
from tests.shared_runs import small_run
from tests.warm import programs

pytestmark = pytest.mark.thorough

WATCHDOG_S = 30.0
FIRST_BLOCK = 400
"""Ticks after which there is something on disk."""
LONG_S = 12.0
"""Simulated time that the recorder does not outrun."""
FULL_S = 5.0
"""Bound of the end of a run whose disk is full."""


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_full_disk_under_the_events_ends_no_run(config: RackConfig, tmp_path: Path) -> None:
    folder, display = tmp_path / "run", Keeping()
    folder.mkdir()
    (folder / "events.jsonl").symlink_to("/dev/full")
    assert run_rack(config, 0.5, folder, display).worked
    assert display.texts.count("events.jsonl ends here: No space left on device") == 1


class AtTick(Display):
    """Strikes the recorder of the run, by default with a signal, `times` times, when the run has
    got to some tick."""

    period_s = 0.05

    def __init__(
        self,
        number: signal.Signals,
        tick: int = FIRST_BLOCK,
        view: Path | None = None,
        times: int = 1,
    ) -> None:
        self._number, self._tick, self._view, self._times = number, tick, view, times
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
        if snapshot.tick > self._tick and len(self.struck) < self._times and self._has_view():
            for pid in programs("rack.tools.recording.recorder"):
                if pid not in self.struck:
                    self.struck.append(pid)
                    self.strike(pid)

    def strike(self, pid: int) -> None:
        """Send the signal."""
        os.kill(pid, self._number)


class Held(AtTick):
    """Strikes while a rack in lockstep, launched with `step`, is held at the tick: however late the
    looks of a busy machine, the run is not over. Lets it go on once it has struck."""

    def __init__(self, rack: str, number: signal.Signals, tick: int = FIRST_BLOCK, times: int = 1):
        super().__init__(number, -1, times=times)
        self._rack, self._hold_at = rack, tick + 1

    def show(self, snapshot: Snapshot) -> None:
        """Let it run to the tick; strike there."""
        with closing(Segment.attach(self._rack)) as segment:
            if segment.words[System.HELD] == self._hold_at:
                super().show(snapshot)
            is_done = len(self.struck) == self._times
            segment.words[System.HOLD_AT] = 0 if is_done else self._hold_at


class FillingDisk(AtTick):
    """Lets no file of the recorder grow beyond some bytes, from some tick on: to it the disk is
    full."""

    def __init__(self) -> None:
        super().__init__(signal.SIGKILL)
        self.full_at = 0.0

    def strike(self, pid: int) -> None:
        """Fill the disk."""
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (4096, 4096))
        self.full_at = time.monotonic()


def notes_of(recording: Recording) -> list[str]:
    return [event["text"] for event in recording.events if event["kind"] == "recorder"]


def counts(recording: Recording) -> dict[str, int]:
    """Return the rows of every task and every mailbox."""
    rows = {task: len(cycles) for task, cycles in recording.cycles.items()}
    return rows | {name: len(recording.signal(name, "serial")) for name in recording.mailboxes}


def realtime(config: RackConfig) -> RackConfig:
    return config.model_copy(update={"clock": config.clock.model_copy(update={"mode": "realtime"})})


@pytest.mark.slow
def test_a_recorder_that_is_killed_is_restarted_and_goes_on_where_it_was(
    config: RackConfig, tmp_path: Path
) -> None:
    display = Held(config.name, signal.SIGKILL)
    result = run_rack(config, LONG_S, tmp_path / "run", display, step=True)
    assert display.struck
    assert (result.worked, result.recording) == (True, "complete")
    recording = Recording(tmp_path / "run")
    assert (
        notes_of(recording)[0]
        == "the recorder ended with status -9; restarted, 1 of at most 3 times"
    )
    # In lockstep the clock waits for the next one as it did for the first: not one row is missing.
    serials = recording.signal("lower.status", "serial")
    assert np.array_equal(serials, np.arange(1, result.outcome.ticks + 1))
    assert not any(recording.lost.values())
    whole = run_rack(config, LONG_S, tmp_path / "whole", Display())
    assert result.outcome.digest == whole.outcome.digest
    assert counts(recording) == counts(Recording(tmp_path / "whole"))
    # The viewer's file is not written over.
    assert {"run.rrd", "run-2.rrd"} < {path.name for path in (tmp_path / "run").iterdir()}


@pytest.mark.slow
def test_recorders_killed_before_their_first_block_cost_no_row(
    config: RackConfig, tmp_path: Path
) -> None:
    # Each new one, too, is struck as soon as it is there.
    display = Held(config.name, signal.SIGKILL, tick=0, times=recorder_process.RESTARTS)
    result = run_rack(config, LONG_S, tmp_path / "run", display, step=True)
    assert len(display.struck) == recorder_process.RESTARTS
    assert (result.worked, result.recording, result.rows_lost) == (True, "complete", {})
    serials = Recording(tmp_path / "run").signal("lower.status", "serial")
    assert np.array_equal(serials, np.arange(1, result.outcome.ticks + 1))


@pytest.mark.slow
def test_a_recorder_that_is_stopped_is_replaced_and_lockstep_waits(
    config: RackConfig, tmp_path: Path
) -> None:
    display = Held(config.name, signal.SIGSTOP)
    result = run_rack(config, LONG_S, tmp_path / "run", display, step=True)
    assert display.struck
    assert (result.worked, result.recording) == (True, "complete")
    recording = Recording(tmp_path / "run")
    assert notes_of(recording)[0] == "the recorder is not responding: killed"
    assert len(recording.signal("lower.status", "serial")) == result.outcome.ticks


@pytest.mark.slow
def test_lockstep_waits_for_a_recorder_that_comes_late(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_process, "ATTACH_S", 0.0)
    result = run_rack(config, LONG_S, tmp_path / "run", Display())
    assert notes_of(Recording(tmp_path / "run"))[:2] == [NO_RECORDER, "the recorder has begun"]
    assert (result.worked, result.recording) == (True, "complete")


@pytest.mark.slow
def test_a_run_whose_recorder_is_killed_too_often_has_not_worked_and_says_what_is_missing(
    config: RackConfig, tmp_path: Path
) -> None:
    display = Held(config.name, signal.SIGKILL, times=recorder_process.RESTARTS + 1)
    result = run_rack(config, LONG_S, tmp_path / "run", display, step=True)
    assert len(display.struck) == recorder_process.RESTARTS + 1
    assert (result.outcome.worked, result.worked) == (True, False)
    recording, ticks = Recording(tmp_path / "run"), result.outcome.ticks
    taken = counts(recording)
    missing = {name: ticks - taken[name] for name in ("lower", "lower.status")}
    assert missing["lower"] > ticks / 4
    assert (
        {name: result.rows_lost[name] for name in missing}
        == missing
        == {n: recording.lost[n] for n in missing}
    )
    worst = max(result.rows_lost, key=lambda name: (result.rows_lost[name], name))
    (gap,) = recording.gaps()
    # Slow rings lack what came since their last message.
    assert (gap.first <= taken["lower"], gap.last) == (True, ticks - 1)
    assert set(gap.rings) == set(result.rows_lost)
    assert (
        result.recording
        == f"{missing['lower']:,} of {ticks:,} rows of {worst} are missing (and rows of"
        f" {len(result.rows_lost) - 1} more tasks and mailboxes); {gap}; the recorder ended with"
        " status -9"
    )
    assert result.failure().endswith(result.recording)
    report, text = write_report(tmp_path / "run")
    assert f"Times of lower are from {taken['lower']:,} of {ticks:,} cycles." in text
    assert f"- {gap}" in text
    assert report["gaps"] == [{"first": gap.first, "last": gap.last, "rings": gap.rings}]
    assert f"lower: judged by {taken['lower']:,} of {ticks:,} cycles" in analysis_text(
        Analysis.of(recording)
    )


@pytest.mark.slow
def test_rows_that_no_recorder_took_are_missing(config: RackConfig, tmp_path: Path) -> None:
    taken, left = tmp_path / "taken", tmp_path / "left"
    with Rack(config) as rack:
        for folder in (taken, left):
            folder.mkdir()
            (folder / CONFIG).write_text(config.text())
        with Recorder(rack.segment, left):
            rack.run(0.5)
        with Recorder(rack.segment, taken) as recorder:
            recorder.drain()
        assert Recording(taken).missing(rack.segment) == {}
        missing = Recording(left).missing(rack.segment)
    assert (missing["lower.status"], missing["lower"]) == ((200, 200), (200, 200))
    assert missing["upper.status"] == (25, 25)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["drop", "corrupt", "delay", "reorder", "masquerade"])
def test_messages_that_readers_reject_are_not_missing_nor_taken_twice(
    small: Path, rack_name: str, kind: str
) -> None:
    """Faults of messages, and a recorder that is killed after them."""
    lasts = "" if kind == "masquerade" else ", for = '0.4s'"
    faults = f"fault=[{{ kind = '{kind}', board = 'lower', at = 0.4{lasts} }}]"
    folder = small.parent / "run"
    config, display = load(small, [f"name={rack_name}", faults]), Held(rack_name, signal.SIGKILL)
    result = run_rack(config, LONG_S, folder, display, step=True)
    assert display.struck
    assert result.recording == "complete"
    serials = Recording(folder).signal("lower.status", "serial")
    assert np.all(np.diff(serials) > 0)


@pytest.mark.slow
def test_lockstep_waits_for_its_recorder_while_a_task_floods_the_rings(
    small: Path, rack_name: str
) -> None:
    """In each cycle as many messages as the ring of a slow task holds in a second."""
    faults = "fault=[{ kind = 'babble', board = 'upper', at = 0.4, for = '1s', writes = 25 }]"
    result = run_rack(
        load(small, [f"name={rack_name}", faults]), LONG_S, small.parent / "run", Display()
    )
    assert result.faults[0].count > 1
    assert result.recording == "complete"


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_full_disk_ends_the_run_within_seconds_and_names_the_folder(
    config: RackConfig, tmp_path: Path, mode: str
) -> None:
    display = FillingDisk()
    # Python's own helpers of earlier tests stay until the end.
    before = set(children_of(os.getpid()))
    wanted = config if mode == "lockstep" else realtime(config)
    with pytest.raises(Failure) as caught:
        run_rack(wanted, 5 * LONG_S, tmp_path / "run", display)
    assert time.monotonic() - display.full_at < FULL_S
    assert len(display.struck) == 1
    assert caught.value.status == 1
    assert re.fullmatch(
        f"{tmp_path}/run: File too large: the recording ends at tick [0-9]+", str(caught.value)
    )
    assert config.name not in racks()
    assert set(children_of(os.getpid())) <= before


@pytest.mark.slow
def test_a_disk_that_is_full_from_the_start_ends_the_run(
    config: RackConfig, tmp_path: Path
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / SPOOL).symlink_to("/dev/full")
    with pytest.raises(Failure, match="run: No space left on device: the recording ends at tick 0"):
        run_rack(config, 5 * LONG_S, tmp_path / "run", Display())


@pytest.mark.slow
def test_a_folder_that_cannot_be_written_is_named(config: RackConfig, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / CONFIG).symlink_to("/dev/full")
    with pytest.raises(Failure, match="/run: No space left on device"):
        run_rack(config, 1.0, tmp_path / "run", Display())
    assert config.name not in racks()


@pytest.mark.slow
def test_what_a_killed_recorder_took_is_readable(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_process, "RESTARTS", 0)
    display = AtTick(signal.SIGKILL, view=tmp_path / "run" / "run.rrd")
    result = run_rack(realtime(config), LONG_S, tmp_path / "run", display)
    # The run went well, but is not recorded as wanted.
    assert (result.outcome.worked, result.worked) == (True, False)
    assert re.fullmatch(
        r"[0-9,]+ of [0-9,]+ rows of lower.* are missing .*ended with status -9", result.recording
    )
    report, _ = write_report(tmp_path / "run")
    assert (report["worked"], report["recording"]) == (False, result.recording)
    assert report["rows_lost"] == result.rows_lost
    assert notes_of(Recording(tmp_path / "run")) == [
        "the recorder ended with status -9; the run continues, unrecorded"
    ]
    ticks = pq.read_table(tmp_path / "run" / "signals" / "lower.status.parquet")["tick"].to_numpy()
    assert ticks.max() > FIRST_BLOCK / 2
    repaired = tmp_path / "repaired.rrd"
    for command in (
        ["optimize", tmp_path / "run" / "run.rrd", "-o", repaired],
        ["verify", repaired],
    ):
        subprocess.run(
            [executable(), "rrd", *command], check=True, capture_output=True, timeout=WATCHDOG_S
        )
    assert RrdReader(str(repaired)).stream().filter(content="/boards/**").to_chunks()


@pytest.mark.slow
def test_a_recorder_that_is_stopped_is_replaced_in_real_time_too(
    config: RackConfig, tmp_path: Path
) -> None:
    result = run_rack(realtime(config), 2.0, tmp_path / "run", AtTick(signal.SIGSTOP))
    assert result.outcome.worked
    # The rings hold two seconds: the whole run.
    assert (result.worked, result.recording) == (True, "complete")


@pytest.mark.slow
def test_a_recorder_that_comes_late_delays_no_run(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_process, "ATTACH_S", 0.0)
    result = run_rack(realtime(config), 3.0, tmp_path / "run", Display())
    assert (result.worked, result.recording) == (True, "complete")
    assert notes_of(Recording(tmp_path / "run"))[:1] == [NO_RECORDER]


@pytest.mark.slow
def test_two_recorders_do_not_write_into_one_folder(config: RackConfig, tmp_path: Path) -> None:
    with Rack(config) as rack, Recorder(rack.segment, tmp_path):
        with pytest.raises(Failure, match="another recorder is running there"):
            Recorder(rack.segment, tmp_path)
        with pytest.raises(Failure, match="another recorder is running there"):
            mend(tmp_path)


@pytest.mark.slow
def test_a_run_is_opened_once_the_recorder_of_a_launcher_that_was_killed_has_finished(
    config: RackConfig, tmp_path: Path
) -> None:
    (tmp_path / CONFIG).write_text(config.text())
    with Rack(config) as rack, ThreadPoolExecutor(1) as pool:
        recorder = Recorder(rack.segment, tmp_path)
        rack.run(0.5)
        opened = pool.submit(Recording, tmp_path)
        with pytest.raises(TimeoutError):
            opened.result(3 * recorder_process.LOOK_S)
        recorder.drain()
        recorder.close()
        assert len(opened.result(WATCHDOG_S).trace("lower")) == 200
    assert not (tmp_path / SPOOL).exists()


def test_a_spool_that_is_cut_anywhere_gives_what_is_whole(
    config: RackConfig, tmp_path: Path
) -> None:
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
        tables = (folder / "signals").iterdir()
        found.append(sum(pq.read_table(table).num_rows for table in tables))
    assert found == sorted(found, reverse=True)
    assert found[0] > 200 > found[-1]


def test_a_gap_stays_where_it_was_after_the_recorder_is_gone(
    config: RackConfig, tmp_path: Path
) -> None:
    (tmp_path / CONFIG).write_text(config.text())
    rows = np.zeros(300, dtype=RECORD)
    rows["tick"] = np.arange(300)
    spool = Spool(tmp_path, wire(config), Launch(*range(1, 1 + len(Launch._fields))))
    spool.add("lower", rows[:100], 0)
    spool.flush(now=True)
    # Two drains that one flush writes, with rows lost between them.
    spool.add("lower", rows[100:120], 0)
    spool.add("lower", rows[220:], 100)
    spool.flush(now=True)
    spool.close()
    assert [str(gap) for gap in Recording(tmp_path).gaps()] == [
        "ticks 120 to 219 of lower are not recorded"
    ]


@pytest.mark.slow
def test_a_recorder_that_comes_after_the_start_says_of_how_many_cycles_its_figures_are(
    config: RackConfig, tmp_path: Path
) -> None:
    (tmp_path / CONFIG).write_text(config.text())
    with Rack(config) as rack:
        # The rings hold two seconds.
        rack.run(4.0)
        with Recorder(rack.segment, tmp_path) as recorder:
            recorder.drain()
    recording = Recording(tmp_path)
    taken = len(recording.cycles["lower"])
    assert recording.untraced()["lower"] == (taken, 1600)
    (gap,) = recording.gaps()
    assert (gap.first, set(gap.rings)) == (
        0,
        {name for name, lost in recording.lost.items() if lost},
    )
    assert f"lower: judged by {taken:,} of 1,600 cycles" in analysis_text(Analysis.of(recording))
