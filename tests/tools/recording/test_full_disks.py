"""A full disk or an unwritable folder: the user gets a message, and no run hangs."""

from __future__ import annotations

import errno
import os
import re
import sys
import time
from pathlib import Path

import pytest

from rack.backplane.segment import list_racks
from rack.boards.config import RackConfig
from rack.tools.console.answer import Failure
from rack.tools.launch.launch import run_rack
from rack.tools.launch.verdict import list_failures
from rack.tools.monitor.display import Display
from rack.tools.recording.file_names import CONFIG, SPOOL
from rack.tools.recording.recording import Recording
from tests.processes import children_of, run_to_end
from tests.tools.command_line import BOUND_S, rack
from tests.tools.recording.struck_recorders import LONG_S, FillingDisk, Keeping, notes_of, realtime

pytestmark = pytest.mark.thorough

FULL_S = 40.0
"""Bound of the end of a run whose disk is full: well below what it would last."""


def full_file(folder: Path, name: str) -> Path:
    """Return the folder of a run in which a file is on a full disk."""
    folder.mkdir()
    (folder / name).symlink_to("/dev/full")
    return folder


def test_a_full_disk_ends_the_view_and_nothing_else(config: RackConfig, tmp_path: Path) -> None:
    folder = full_file(tmp_path / "run", "run.rrd")
    result = run_rack(config, 5.0, folder, Display())
    recording = Recording(folder)
    assert result.worked
    assert result.recording == "complete"
    assert len(recording.cycles["lower"]) == 2000
    (line,) = notes_of(recording)
    assert line.startswith("run.rrd ends here: ")


def test_a_full_disk_under_the_events_ends_no_run(config: RackConfig, tmp_path: Path) -> None:
    display = Keeping()
    result = run_rack(config, 0.5, full_file(tmp_path / "run", "events.jsonl"), display)
    assert (result.outcome.is_success, result.worked) == (True, False)
    assert list_failures(result.outcome, result.recording, result.failed) == [
        "the recording is incomplete: events.jsonl ends before the run"
    ]
    assert display.texts.count("events.jsonl ends here: No space left on device") == 1


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_full_disk_ends_the_run_within_seconds_and_names_the_folder(
    config: RackConfig, tmp_path: Path, mode: str
) -> None:
    display = FillingDisk()
    # Helper processes of Python from earlier tests stay until the end.
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
    assert config.name not in list_racks()
    assert set(children_of(os.getpid())) <= before


@pytest.mark.parametrize(
    ("name", "why"),
    [
        (SPOOL, "/run: No space left on device: the recording ends at tick 0"),
        (CONFIG, "/run: No space left on device"),
    ],
)
def test_a_disk_that_is_full_from_the_start_ends_the_run(
    config: RackConfig, tmp_path: Path, name: str, why: str
) -> None:
    folder = full_file(tmp_path / "run", name)
    with pytest.raises(Failure, match=why):
        run_rack(config, 5 * LONG_S, folder, Display())
    assert config.name not in list_racks()


@pytest.mark.skipif(os.getuid() != 0, reason="only root mounts a file system")
@pytest.mark.parametrize(
    ("size", "mode"), [("48k", "realtime"), ("100k", "lockstep"), ("400k", "realtime")]
)
def test_a_small_disk_ends_the_run_with_one_line_and_leaves_no_process(
    small: Path, rack_name: str, tmp_path: Path, size: str, mode: str
) -> None:
    """Recorder, viewer's file and events race for the last bytes."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = (
        *("unshare", "--mount", "sh", "-c"),
        'mount -t tmpfs -o size=$0 tmpfs "$1" && shift && exec "$@"',
        *(size, disk, sys.executable, "-m", "rack.tools.cli", "run", small),
        *("--set", f"name={rack_name}", "--set", f"clock.mode={mode}"),
        *("--seconds", str(5 * LONG_S), "--out", disk / "run"),
    )
    done = run_to_end(command, BOUND_S)
    assert done.returncode == 1, done
    *_, last = done.stderr.splitlines()
    assert last.startswith(f"{disk}/run: No space left on device")
    assert rack_name not in list_racks()


def test_a_run_whose_report_cannot_be_written_fails(
    small: Path, rack_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(folder: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("rack.tools.report.report.write_report", fail)
    words = ("--seconds", 0.2, "--set", f"name={rack_name}", "--out", tmp_path / "run")
    done = rack("run", small, *words)
    assert done.returncode == 1
    assert f"{tmp_path}/run: no report: [Errno 28] No space left on device" in done.stderr
