"""Damage to the files of a run: no flipped bit is read as another value, and nothing but regular
files is opened."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config import RackConfig, load
from rack.boards.events import Event
from rack.tools.console.answer import Failure
from rack.tools.recording.checksums import CHECKSUMS, checked_line, read_line
from rack.tools.recording.parquet import CONFIG, HEAD
from rack.tools.recording.recorder.recorder import Recorder
from rack.tools.recording.recorder_process import SPOOL
from rack.tools.recording.recording import Recording
from rack.tools.recording.run_files import tally
from rack.tools.timing.analysis.report import write_report
from tests.shared_runs import small_run
from tests.tools.command_line import rack

BOUND_S = 30
"""Bound of a command on a damaged run."""
SIGNALS = "signals/*/*"
FLIPS = 25


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with its report."""
    folder = small_run(tmp_path_factory)
    write_report(folder)
    return folder


@pytest.fixture
def damaged(run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "run"))


@pytest.fixture
def config(small: Path, rack_name: str) -> RackConfig:
    """A rack of two levels that count, without an arm."""
    return load(small, [f"name={rack_name}"])


@contextmanager
def bounded() -> Iterator[None]:
    """Fail what hangs."""

    def give_up(number: int, frame: object) -> None:
        raise TimeoutError(f"hangs for {BOUND_S} s")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(BOUND_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def values(folder: Path) -> object:
    """Return everything that a recording says."""
    found = Recording(folder)
    signals = {
        (box.name, field): found.signal(box.name, field).tolist()
        for box in found.layout.timed
        for field in (*HEAD, *sorted(found.fields(box.name)))
    }
    cycles = {task: rows.tobytes() for task, rows in found.cycles.items()}
    return repr((found.config, cycles, signals, found.events, found.lost, found.kept, found.layout))


def failure_of(folder: Path) -> str:
    """Return why a run is refused, empty if it is not."""
    try:
        values(folder)
    except Failure as failure:
        return str(failure)
    return ""


def flipped_bits(folder: Path, pattern: str, flips: int) -> Iterator[tuple[Path, bytes]]:
    """Yield files with the same file after one of its bits was flipped, the bit drawn from all
    bits of all files."""
    files = sorted(path for path in folder.glob(pattern) if path.is_file())
    sizes = [path.stat().st_size for path in files]
    draw = random.Random(41)
    for path in draw.choices(files, sizes, k=flips):
        content = bytearray(path.read_bytes())
        content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
        yield path, bytes(content)


@pytest.mark.slow
@pytest.mark.parametrize(
    "pattern", [SIGNALS, "cycles.parquet", "events.jsonl", CONFIG, CHECKSUMS, "report.*"]
)
def test_a_flipped_bit_is_named_or_changes_no_value(damaged: Path, pattern: str) -> None:
    whole = values(damaged)
    report = rack("report", damaged, "--json").stdout
    for path, content in flipped_bits(damaged, pattern, FLIPS):
        before = path.read_bytes()
        path.write_bytes(content)
        why = failure_of(damaged)
        if why:
            # A damaged checksum is taken for a damaged file; the line names both.
            assert str(path.relative_to(damaged)) in why
            assert len(why.splitlines()) == 1
        else:
            assert values(damaged) == whole
            assert pattern in (CHECKSUMS, "report.*")
            assert rack("report", damaged, "--json").stdout == report
        path.write_bytes(before)


@pytest.mark.slow
def test_a_flipped_bit_in_the_spool_of_a_killed_recorder_is_named(
    config: RackConfig, tmp_path: Path
) -> None:
    folder = tmp_path / "killed"
    folder.mkdir()
    (folder / CONFIG).write_text(config.text())
    with Rack(config) as running, Recorder(running.segment, folder) as recorder:
        running.run(0.5)
        recorder.drain()
        recorder._spool.flush(now=True)
        shutil.copytree(folder, tmp_path / "copy")
    for path, content in flipped_bits(tmp_path / "copy", SPOOL, FLIPS):
        again = Path(shutil.copytree(path.parent, tmp_path / "again"))
        (again / SPOOL).write_bytes(content)
        with pytest.raises(Failure, match=r"recorder\.spool: "):
            Recording(again)
        shutil.rmtree(again)
    assert values(tmp_path / "copy")


@pytest.mark.slow
def test_a_flipped_bit_in_a_stretch_of_a_flight_recorder_is_named(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    config = load(small, [f"name={rack_name}", 'record={ keep = "60 s" }'])
    folder = tmp_path / "flight"
    folder.mkdir()
    (folder / CONFIG).write_text(config.text())
    with Rack(config) as running, Recorder(running.segment, folder) as recorder:
        running.run(0.5)
        recorder.drain()
    assert len([*folder.glob("stretches/*")]) > 1
    for path, content in flipped_bits(folder, "stretches/*", FLIPS):
        before = path.read_bytes()
        path.write_bytes(content)
        with pytest.raises(Failure, match=path.name):
            tally(folder)
        path.write_bytes(before)
    assert values(folder)


@pytest.mark.slow
def test_an_error_in_a_recorder_costs_no_row(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recorder without memory for a block of rows ends; the next one takes them from its
    spool."""
    (tmp_path / CONFIG).write_text(config.text())

    def fail(*arguments: object, **named: object) -> None:
        raise MemoryError

    with Rack(config) as running, bounded():
        segment = running.segment
        running.run_in_background(3.0)
        with ExitStack() as stack:
            recorder = stack.enter_context(Recorder(segment, tmp_path))
            while segment.words[System.TICK] < 1000:
                recorder.drain()
            monkeypatch.setattr("rack.tools.recording.run_files.RunFiles.add", fail)
            with pytest.raises(MemoryError) as error:
                recorder.drain()
            monkeypatch.undo()
            stack.pop_all().__exit__(error.type, error.value, error.tb)
        with Recorder(segment, tmp_path) as recorder:
            recorder.follow()
        recording = Recording(tmp_path)
        assert recording.missing(segment) == {}
    serials = recording.signal("lower.status", "serial")
    assert np.array_equal(serials, np.arange(1, 1201))


def test_a_value_that_is_not_a_number_is_null_in_json_and_comes_back() -> None:
    line = checked_line({"kind": "detection", "value": float("nan")})
    assert json.loads(line, parse_constant=pytest.fail)["value"] is None
    assert np.isnan(read_line(line)["value"])
    with pytest.raises(ValueError, match="checksum"):
        read_line(line.replace("detection", "Detection"))


@pytest.mark.slow
@pytest.mark.thorough
def test_nan_in_a_sensor_leaves_strict_json(tmp_path: Path, rack_name: str) -> None:
    faults = "fault=[{ kind = 'sensor-nan', board = 'servo', joint = 2, at = 0.5, for = '0.1s' }]"
    done = rack(
        *("run", "nasrem", "--lockstep", "--seconds", 1, "--out", tmp_path / "run"),
        *("--set", f"name={rack_name}", "--set", faults, "--json"),
    )
    json.loads(done.stdout, parse_constant=pytest.fail)
    lines = (tmp_path / "run" / "events.jsonl").read_text().splitlines()
    found = [json.loads(line, parse_constant=pytest.fail) for line in lines]
    (event,) = [one for one in found if one.get("code") == "sensor_range"]
    assert event["value"] is None
    assert "nan" in event["text"]
    # As a program reads it, the number is there again.
    (event,) = [
        one for one in Recording(tmp_path / "run").events if one.get("value") != one.get("value")
    ]
    assert Event(**event).code == "sensor_range"


def take_fifo(path: Path) -> None:
    os.mkfifo(path)


def take_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


COMMANDS: dict[str, Callable[[Path, Path], tuple[object, ...]]] = {
    "report": lambda run, out: ("report", run),
    "against": lambda run, out: ("report", run, "--against", run),
    "analyze": lambda run, out: ("analyze", run, "--out", out),
    "export": lambda run, out: ("export", run, "--out", out / "run.mcap"),
    "gantt": lambda run, out: ("gantt", f"{run}/", "--out", out),
    "replay": lambda run, out: ("replay", run, "--out", out / "run.rrd"),
    "rewind": lambda run, out: ("rewind", run, "--json"),
    "check": lambda run, out: ("check", run / CONFIG, "--from", run),
    "entries": lambda run, out: ("run", "fig2", "--lockstep", "--entries", run, "--out", out / "r"),
    "from": lambda run, out: ("run", "--from", f"{run}@1", "--out", out / "r"),
}
READ = ("cycles.parquet", "signals/lower.status.parquet/0001.parquet", CHECKSUMS, CONFIG)
"""Files without which no command can read a run."""


@pytest.mark.slow
@pytest.mark.parametrize("name", READ)
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_on_a_run_refuses_a_fifo_or_a_device_for_a_file(
    damaged: Path, tmp_path: Path, command: str, name: str
) -> None:
    for take_place in (take_fifo, take_device):
        (damaged / name).unlink()
        take_place(damaged / name)
        with bounded():
            done = rack(*COMMANDS[command](damaged, tmp_path))
        assert done.returncode == 2, done
        assert Path(name).name in done.stderr
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
@pytest.mark.parametrize("take_place", [take_fifo, take_device])
@pytest.mark.parametrize("name", ["events.jsonl", "origin.json", "report.json", "report.md"])
def test_a_report_reads_regular_files_only(
    damaged: Path, name: str, take_place: Callable[[Path], None]
) -> None:
    """What it needs is named; its own files are replaced."""
    whole = rack("report", damaged).stdout
    if not name.startswith("report"):
        # Otherwise the report that is there is right.
        (damaged / "report.json").unlink()
    (damaged / name).unlink(missing_ok=True)
    take_place(damaged / name)
    with bounded():
        done = rack("report", damaged)
    if name.startswith("report"):
        assert (done.returncode, done.stdout) == (0, whole)
        assert (damaged / name).is_file()
        assert not (damaged / name).is_symlink()
    else:
        assert done.returncode == 2
        assert f"{name}: not a regular file" in done.stderr


def test_a_damaged_file_of_the_viewer_is_named(damaged: Path) -> None:
    path = damaged / "run.rrd"
    path.write_bytes(path.read_bytes()[:-1])
    for run in (damaged, path):
        done = rack("replay", run)
        assert done.returncode == 2
        assert done.stderr.startswith(f"{path}: damaged")
