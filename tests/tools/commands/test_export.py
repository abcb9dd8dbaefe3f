"""Tests the files that `rack export` writes, and what it refuses. Their contents: ecosystem."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace

from tests.tools.command_line import rack, read_answer, read_refusal
from tests.tools.conftest import Record

pytestmark = pytest.mark.slow

FILES = {"mcap": "run.mcap", "rosbag2": "run-rosbag2", "perfetto": "run.pftrace"}
"""Default name of each kind."""


def export(run: Path, kind: str) -> int:
    """Export a run under the default name, and return the number of entries."""
    answer = read_answer("export", run, "--to", kind)
    path = run / FILES[kind]
    files = [path] if path.is_file() else [*path.iterdir()]
    assert answer["file"] == str(path)
    assert answer["bytes"] == sum(file.stat().st_size for file in files)
    assert [*run.glob("*.part")] == []
    return int(answer["slices" if kind == "perfetto" else "messages"])


@pytest.mark.thorough
def test_files_are_written_whole_and_counted(run: Path) -> None:
    count = export(run, "mcap")
    assert export(run, "rosbag2") == count
    bag = run / FILES["rosbag2"]
    assert {file.name for file in bag.iterdir()} == {"metadata.yaml", "run-rosbag2.mcap"}
    for path in (run / FILES["mcap"], bag / "run-rosbag2.mcap"):
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == count
    slices = export(run, "perfetto")
    packets = Trace.FromString((run / FILES["perfetto"]).read_bytes()).packet
    events = [packet.track_event for packet in packets if packet.HasField("track_event")]
    assert slices == sum(event.type != event.TYPE_SLICE_END for event in events)


@pytest.mark.parametrize("kind", FILES)
def test_an_existing_file_is_kept(run: Path, kind: str, tmp_path: Path) -> None:
    path = tmp_path / "kept"
    path.write_text("kept")
    wanted = f"{path}: exists already; remove it, or give another --out"
    assert read_refusal(rack("export", run, "--to", kind, "--out", path)) == wanted
    assert path.read_text() == "kept"


def test_a_refused_export_is_reported_in_one_line(
    run: Path, record: Record, tmp_path: Path
) -> None:
    empty, out = record({}).folder, tmp_path / "out"
    out.mkdir()
    new = ("--out", out / "x")
    nothing = f"{empty}: no message is recorded, so a bag would be empty"
    no_cycle = f"{empty}: no cycle is recorded, so the trace would be empty"
    for words, why in (
        ((out,), f"{out}: not a run: it has no config.toml"),
        ((run, "--out", "/dev/full/x"), '"/dev/full/x.part": Not a directory'),
        ((empty, *new), nothing),
        ((empty, "--to", "rosbag2", *new), nothing),
        ((empty, "--to", "perfetto", *new), no_cycle),
    ):
        assert read_refusal(rack("export", *words)) == why
    assert [*out.iterdir()] == []


def test_an_unknown_kind_is_refused_with_the_known_ones(run: Path) -> None:
    done = rack("export", run, "--to", "bag")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[-1] == (
        "Error: Invalid value for '--to': Value error, 'bag' is not one of 'mcap', 'rosbag2',"
        " 'perfetto'."
    )


@pytest.mark.parametrize(
    ("kind", "package", "extra"),
    [("mcap", "rosbags", "export"), ("rosbag2", "rosbags", "export"), ("perfetto",) * 3],
)
def test_a_missing_package_is_named_with_the_line_that_installs_it(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, package: str, extra: str
) -> None:
    for name in list(sys.modules):
        if name.startswith(("rack.tools.ecosystem", f"{package}.")):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    refusal = read_refusal(rack("export", run, "--to", kind, "--out", tmp_path / "x"))
    assert refusal == f"--to {kind} needs {package}: pip install 'nasrem-rack[{extra}]'"
    assert [*tmp_path.iterdir()] == []
