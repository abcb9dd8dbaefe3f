"""Damage to the files of a run: no flipped bit is read as another value.

Only regular files are opened.
"""

from __future__ import annotations

import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from rack.boards import Rack
from rack.boards.config import load
from rack.boards.events import Event
from rack.tools.console.answer import Failure
from rack.tools.recording.checksums import CHECKSUMS, format_checked_line, parse_checked_line
from rack.tools.recording.file_names import CONFIG, SPOOL
from rack.tools.recording.parquet import HEAD_COLUMNS
from rack.tools.recording.recorder.recorder import Recorder
from rack.tools.recording.recording import Recording
from rack.tools.report.report import write_report
from tests.conftest import EXHAUSTIVE
from tests.shared_runs import small_run
from tests.tools.command_line import rack

BOUND_S = 100
"""Bound of a command on a damaged run."""
SIGNALS = "signals/*/*"
FLIPS = 15 if EXHAUSTIVE else 6


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with its report."""
    folder = small_run(tmp_path_factory)
    write_report(folder)
    return folder


def read_values(folder: Path) -> object:
    """Return everything that a recording says."""
    found = Recording(folder)
    signals = {
        (box.name, field): found.read_signal(box.name, field).tolist()
        for box in found.layout.timed
        for field in (*HEAD_COLUMNS, *sorted(found.list_fields(box.name)))
    }
    cycles = {task: rows.tobytes() for task, rows in found.cycles.items()}
    return repr(
        (found.config, cycles, signals, found.events, found.lost_rows, found.kept, found.layout)
    )


def flipped_bits(folder: Path, pattern: str, flips: int) -> Iterator[tuple[Path, bytes]]:
    """Yield files, each after one of its bits was flipped.

    The bits are drawn from all bits of all matching files.
    """
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
    whole = read_values(damaged)
    report = rack("report", damaged, "--json").stdout
    for path, content in flipped_bits(damaged, pattern, FLIPS):
        before = path.read_bytes()
        path.write_bytes(content)
        try:
            values, why = read_values(damaged), ""
        except Failure as failure:
            values, why = None, str(failure)
        if why:
            # A damaged checksum looks like a damaged file; the line names both.
            assert str(path.relative_to(damaged)) in why
            assert len(why.splitlines()) == 1
        else:
            assert values == whole
            assert pattern in (CHECKSUMS, "report.*")
            assert rack("report", damaged, "--json").stdout == report
        path.write_bytes(before)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("record", "pattern", "why"),
    [("", SPOOL, r"recorder\.spool: "), ('record={ keep = "60 s" }', "stretches/*", "stretches/")],
    ids=["killed", "flight"],
)
def test_a_flipped_bit_in_the_files_of_a_killed_recorder_is_named(
    small: Path, rack_name: str, tmp_path: Path, record: str, pattern: str, why: str
) -> None:
    config = load(small, [f"name={rack_name}", *([record] if record else [])])
    folder, copy = tmp_path / "run", tmp_path / "copy"
    folder.mkdir()
    (folder / CONFIG).write_text(config.to_toml_text())
    with Rack(config) as running, Recorder(running.segment, folder) as recorder:
        running.run(0.5)
        recorder.drain_rings()
        recorder._spool.flush(now=True)
        # Leave the spool as a killed recorder would.
        shutil.copytree(folder, copy)
    assert [*copy.glob(pattern)]
    for path, content in flipped_bits(copy, pattern, FLIPS):
        again = Path(shutil.copytree(copy, tmp_path / "again"))
        (again / path.relative_to(copy)).write_bytes(content)
        with pytest.raises(Failure, match=why):
            Recording(again)
        shutil.rmtree(again)
    assert read_values(copy)


def test_nan_is_null_in_json_and_is_restored() -> None:
    line = format_checked_line({"kind": "detection", "value": float("nan")})
    assert json.loads(line, parse_constant=pytest.fail)["value"] is None
    assert np.isnan(parse_checked_line(line)["value"])
    with pytest.raises(ValueError, match="checksum"):
        parse_checked_line(line.replace("detection", "Detection"))


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
    # Programs that read the line get NaN again.
    (event,) = [
        one for one in Recording(tmp_path / "run").events if one.get("value") != one.get("value")
    ]
    assert Event(**event).code == "sensor_range"


PLACES: tuple[Callable[[Path], None], ...] = (os.mkfifo, lambda path: path.symlink_to("/dev/zero"))
"""Ways to put something else in a file's place."""


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


NEEDED = ("cycles.parquet", "signals/lower.status.parquet/0001.parquet", CHECKSUMS, CONFIG)
"""Files without which no command can read a run."""
CASES = [
    *((command, CONFIG) for command in COMMANDS if command != "report"),
    *(("report", name) for name in (*NEEDED, "events.jsonl", "origin.json")),
]


@pytest.mark.slow
@pytest.mark.timeout(2 * BOUND_S)
@pytest.mark.parametrize(("command", "name"), CASES)
def test_every_command_on_a_run_refuses_a_fifo_or_a_device_for_a_file(
    damaged: Path, tmp_path: Path, command: str, name: str
) -> None:
    # Without this, the stored report would be up to date.
    (damaged / "report.json").unlink()
    for take_place in PLACES:
        (damaged / name).unlink(missing_ok=True)
        take_place(damaged / name)
        done = rack(*COMMANDS[command](damaged, tmp_path))
        assert done.returncode == 2, done
        assert Path(name).name in done.stderr
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
@pytest.mark.timeout(2 * BOUND_S)
@pytest.mark.parametrize("name", ["report.json", "report.md"])
def test_a_report_replaces_its_files_whatever_their_type(damaged: Path, name: str) -> None:
    whole = rack("report", damaged).stdout
    for take_place in PLACES:
        (damaged / name).unlink()
        take_place(damaged / name)
        done = rack("report", damaged)
        assert (done.returncode, done.stdout) == (0, whole)
        assert (damaged / name).is_file()
        assert not (damaged / name).is_symlink()


def test_a_damaged_file_of_the_viewer_is_named(damaged: Path) -> None:
    path = damaged / "run.rrd"
    path.write_bytes(path.read_bytes()[:-1])
    for run in (damaged, path):
        done = rack("replay", run)
        assert done.returncode == 2
        assert done.stderr.startswith(f"{path}: damaged")
