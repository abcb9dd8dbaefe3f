"""Tests `rack export`: the MCAP file contains the recording, with units and meanings."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from rack.tools.recording.recording import Recording
from tests.shared_runs import small_run
from tests.tools.command_line import rack

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_run(tmp_path_factory)


@pytest.fixture(scope="module")
def exported(run: Path) -> Path:
    done = rack("export", run, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["file"] == str(run / "run.mcap")
    assert [*run.glob("*.part")] == []
    return run / "run.mcap"


def test_every_message_is_exported_as_it_was_written(run: Path, exported: Path) -> None:
    recording = Recording(run)
    clock_ns = recording.layout.clock_ns
    ticks: dict[str, list[int]] = {}
    states: dict[str, list[object]] = {}
    times, events = [], []
    with exported.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            value = json.loads(message.data)
            ticks.setdefault(channel.topic, []).append(value["tick"])
            states.setdefault(channel.topic, []).append(value.get("state"))
            assert message.log_time == value["tick"] * clock_ns
            times.append(message.log_time)
            events += [value] if channel.topic == "events" else []
    assert times == sorted(times)
    del ticks["events"]
    wanted = [event for event in recording.events if event.get("tick", -1) >= 0]
    assert sorted(events, key=str) == sorted(wanted, key=str)
    assert {*ticks} == {*recording.mailboxes}
    for name, found in ticks.items():
        assert found == recording.read_signal(name, "tick").tolist()
    assert {*states["lower.status"]} <= {"idle", "executing", "done", "error", "holding"}


def test_schemas_have_units_and_meanings(run: Path, exported: Path) -> None:
    with exported.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        (rack_text,) = [found.metadata for found in reader.iter_metadata()]
    assert summary is not None
    assert rack_text["config.toml"] == Recording(run).config
    schemas = {
        channel.topic: json.loads(summary.schemas[channel.schema_id].data)["properties"]
        for channel in summary.channels.values()
    }
    for box in Recording(run).layout.mailboxes:
        if box.name in schemas:
            fields = schemas[box.name]
            assert fields["tick"]["type"] == "integer"
            for field in box.fields:
                if not field.fields:
                    assert field.meaning in fields[field.name]["description"]
    assert schemas["lower.status"]["state"]["type"] == "string"


def test_a_refused_export_is_reported_in_one_line(
    run: Path, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = exported.stat().st_size
    for words, status, why in (
        ((run,), 2, f"{exported}: exists already; remove it, or give another --out"),
        ((tmp_path,), 2, f"{tmp_path}: not a run: it has no config.toml"),
        ((run, "--out", "/dev/full/x"), 2, '"/dev/full/x.part": Not a directory'),
    ):
        done = rack("export", *words)
        assert (done.returncode, done.stdout, done.stderr) == (status, "", f"{why}\n")
    assert exported.stat().st_size == size
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    monkeypatch.delitem(sys.modules, "rack.tools.ecosystem.mcap_json")
    monkeypatch.delattr("rack.tools.ecosystem.mcap_json")
    done = rack("export", run, "--out", tmp_path / "x.mcap")
    assert (done.returncode, done.stderr) == (
        1,
        "--to mcap needs mcap: pip install 'nasrem-rack[export]'\n",
    )
    assert [*tmp_path.iterdir()] == []
