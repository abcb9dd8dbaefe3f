"""Tests `rack record` on a running rack, and `rack replay` without a screen or a recording."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, suppress
from ctypes import CDLL
from pathlib import Path

import numpy as np
import pytest

from rack.boards import Rack
from rack.boards.config import RackConfig
from rack.boards.crate.line import CrateLine
from rack.tools.commands.record import record
from rack.tools.commands.replay import replay
from rack.tools.console import interrupt
from rack.tools.console.answer import Failure
from rack.tools.recording.checksums import CHECKSUMS
from rack.tools.recording.recording import Recording
from rack.tools.recording.time_line import align_racks
from rack.tools.report.report import write_report
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.window import ViewerWindow
from tests.boards.lan.racks import configs, ring_texts
from tests.boards.runs import end_of, watch_until
from tests.processes import RACK, wait_until
from tests.tools.command_line import read_failure, started
from tests.tools.machines import A, B, recorded
from tests.tools.recording.struck_recorders import has_spooled, realtime
from tests.warm import run_command

pytestmark = pytest.mark.thorough


WATCHDOG_S = 100.0


def recorder_of(name: str, folder: Path) -> AbstractContextManager[subprocess.Popen[str]]:
    """Record a rack that runs, by a command in a process of its own."""
    return started("record", name, "--out", folder, "--json")


def test_a_rack_that_runs_can_be_recorded_until_its_end(config: RackConfig, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with Rack(realtime(config)) as rack:
        rack.start()
        with recorder_of(config.name, folder) as recorder:
            watch_until(rack, (folder / "run.rrd").is_file)
            rack.stop("recorded")
            ticks_run = end_of(rack).ticks
            answer = json.loads(recorder.communicate(timeout=WATCHDOG_S)[0])
    assert recorder.returncode == 0
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != CHECKSUMS]
    assert answer.pop("bytes_per_s") > 0
    written = sum(path.stat().st_size for path in files)
    assert answer == {"rack": config.name, "folder": str(folder), "notes": [], "bytes": written}
    report, _ = write_report(folder)
    assert report["rack"] == config.name
    assert report["tasks"]["lower"]["traced"] > 0
    ticks = Recording(folder).read_signal("lower.status", "tick")
    assert ticks[-1] == ticks_run - 1
    shown = read_component(folder / "run.rrd", "/signals/lower.status/count")
    assert shown.ticks.tolist() == ticks.tolist()


def test_the_recording_so_far_is_saved_while_the_run_continues(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    run, saved = tmp_path / "run", tmp_path / "saved"
    # The rings hold two seconds of simulated time: at this speed a recorder that is late loses
    # nothing.
    settings = (f"name={rack_name}", "clock.mode=realtime", "clock.speed=0.2")
    words = (*(f"--set={setting}" for setting in settings), "--out", run, "--json")
    with started("run", small, *words, stdout=subprocess.DEVNULL, stderr=None) as process:
        try:
            # Some rows of every ring are on the disk.
            wait_until(lambda: has_spooled(run, 10), WATCHDOG_S)
            command = [*RACK, "record", "--save", rack_name, "--out", str(saved), "--json"]
            done = run_command(command, WATCHDOG_S, text=True)
            status = run_command([*RACK, "status", rack_name], WATCHDOG_S, text=True)
            assert process.poll() is None
        finally:
            # Not by a signal, which ends it in a hurry.
            run_command([*RACK, "stop", rack_name], WATCHDOG_S)
            process.wait(WATCHDOG_S)
    # On a slow machine it says how far it is.
    said = [line for line in done.stderr.splitlines() if not line.startswith("merging the rec")]
    assert (done.returncode, said) == (0, [])
    assert re.search(rf"recorded into {run}: [0-9.]+ MB, [0-9.]+ MB/s", status.stdout)
    answer = json.loads(done.stdout)
    files = [path for path in saved.rglob("*") if path.is_file() and path.name != CHECKSUMS]
    assert answer["bytes"] == sum(path.stat().st_size for path in files)
    part, whole = Recording(saved), Recording(run)
    assert not any(whole.lost_rows.values())
    ticks = part.read_signal("lower.status", "tick")
    traced = np.concatenate([rows["tick"] for rows in part.cycles.values()]) * 0.0025
    # From the start, also when a late clock has skipped the first ticks.
    assert answer["since_s"] == 0.0
    assert answer["until_s"] == pytest.approx(traced.max())
    assert 0 < answer["until_s"] < 0.0025 * whole.end_counts["outcome"]["ticks"]
    for name in ("lower", *part.mailboxes):
        rows = part.read_rows(name)
        assert np.array_equal(whole.read_rows(name)[: len(rows)], rows)
    shown = read_component(saved / "run.rrd", "/signals/lower.status/count")
    assert shown.ticks.tolist() == ticks.tolist()
    report, _ = write_report(saved)
    assert report["recording"] == "without the end of the run"


def test_an_unrecorded_rack_cannot_be_saved(config: RackConfig, tmp_path: Path) -> None:
    with Rack(config):
        with pytest.raises(Failure, match=f"--save {config.name}: the rack is not recorded"):
            record(config.name, out=tmp_path / "saved", save=True)
        with pytest.raises(Failure, match="--save, --view: give one of them"):
            record(config.name, out=None, view=True, save=True)


def test_racks_that_work_together_are_replayed_on_one_time_line(
    rack_name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [f"{rack_name}-a", f"{rack_name}-b"]
    one, other = configs(ring_texts(names), tmp_path, "adapter.lan.rate_hz=100")
    with CrateLine() as crate, Rack(one, crate=crate) as near, Rack(other) as far:
        far.start()
        near.start()
        folder = tmp_path / "run"
        with ExitStack() as stack:
            recorders = [stack.enter_context(recorder_of(name, folder / name)) for name in names]
            deadline = time.monotonic() + WATCHDOG_S
            while (
                not all((folder / name / "run.rrd").is_file() for name in names)
                and time.monotonic() < deadline
            ):
                near.watch(0.02)
                far.watch(0.02)
            near.stop("recorded")
            far.stop("recorded")
            while any([near.watch(0.05), far.watch(0.05)]):
                continue
            for recorder in recorders:
                _, err = recorder.communicate(timeout=WATCHDOG_S)
                assert recorder.returncode == 0, err
    replay([folder / name for name in names[::-1]], folder / "run.rrd", against=None)
    note = capsys.readouterr().err.splitlines()[-1]
    assert note.startswith(f"rack '{names[0]}' is on the time line of '{names[1]}'")
    for name in names:
        report, _ = write_report(folder / name)
        assert report["tasks"]["pulse"]["traced"] > 0
    recordings = [Recording(folder / name) for name in names[::-1]]
    place = align_racks(recordings)[1]
    assert place.note == note
    # The two were on one clock: what that showed is the truth.
    true_ns = place.reference_grid.convert_stamps(np.array([place.grid.epoch_ns]))[0]
    assert abs(place.convert_ticks(np.zeros(1, dtype=int), 0)[0] - true_ns) <= place.uncertainty_ns
    assert (
        len(read_component(folder / "run.rrd", f"/{names[0]}/signals/pulse.status/count").ticks) > 0
    )


def kill_thread(pid: int, number: int) -> None:
    """Send a signal to a thread other than the first, as the kernel may do."""
    others = []
    for thread in Path(f"/proc/{pid}/task").iterdir():
        # A thread may end while they are listed.
        with suppress(FileNotFoundError):
            if (thread / "comm").read_text() == "python\n":
                others.append(int(thread.name))
    assert CDLL(None).tgkill(pid, max(others), number) == 0


@pytest.mark.parametrize(
    ("number", "send"),
    [(signal.SIGINT, os.kill), (signal.SIGTERM, os.kill), (signal.SIGHUP, kill_thread)],
    ids=["SIGINT", "SIGTERM", "a thread"],
)
def test_a_signal_ends_a_recording_at_once(
    config: RackConfig, tmp_path: Path, number: signal.Signals, send: Callable[[int, int], None]
) -> None:
    folder = tmp_path / "run"
    with Rack(realtime(config)) as rack:
        rack.start()
        with recorder_of(config.name, folder) as recorder:
            wait_until((folder / "run.rrd").is_file, WATCHDOG_S)
            sent_s = time.monotonic()
            send(recorder.pid, number)
            out, said = recorder.communicate(timeout=WATCHDOG_S)
            took_s = time.monotonic() - sent_s
    assert recorder.returncode == 128 + number, said
    is_finished = not (folder / "recorder.spool").exists()
    assert write_report(folder)[0]["tasks"]["lower"]["traced"] > 0
    if not out:
        # On a slow machine the time for an end in order does not suffice.
        assert took_s > interrupt.BOUND_S
        return
    assert json.loads(out)["notes"] == []
    assert (folder / "run.rrd").exists()
    assert is_finished


def test_replay_writes_only_new_files_and_only_from_runs(tmp_path: Path) -> None:
    out = tmp_path / "both.rrd"
    runs = [recorded(A, [B], tmp_path / "a").folder, recorded(B, [], tmp_path / "b").folder]
    replay(runs, out, against=None)
    made = out.read_bytes()
    for given, file, why in (
        (runs, out, "both.rrd: exists already"),
        (runs, tmp_path / "both.png", "the name of a file for the viewer must end in .rrd"),
        ([runs[0], out], tmp_path / "new.rrd", "both.rrd: not the folder of a run"),
        ([runs[0], tmp_path / "c"], tmp_path / "new.rrd", "c: no such folder"),
        ([runs[0], runs[0]], tmp_path / "new.rrd", "both are of rack 'a'"),
    ):
        assert why in read_failure(replay, given, file, None)
    assert out.read_bytes() == made
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(Failure, match=r"it has no run\.rrd"):
        replay([empty], out=None, against=None)


def test_a_window_without_a_screen_says_what_to_do_elsewhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(Failure, match=r"no screen: .*: rerun run\.rrd"):
        ViewerWindow("run.rrd")
