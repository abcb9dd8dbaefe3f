"""Tests the host side as tools show it: prompt, status, check, and replayed entries."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.mailbox.protocols import open_writer
from rack.boards import Rack
from rack.boards.config import load
from rack.tools.monitor.host_side import EntryRow, list_entry_rows
from rack.tools.monitor.newest_messages import NewestMessages
from rack.tools.recording.recording import Recording
from tests.boards.host.test_board import HOSTED
from tests.tools.command_line import rack, read_answer, read_refusal, started
from tests.tools.conftest import MakeSegment


@pytest.fixture
def hosted(write: Callable[[str, str], Path]) -> Path:
    """A config file of a rack with a host board."""
    return write("hosted.toml", HOSTED)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of a recorded run, and its report."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "hosted.toml").write_text(HOSTED)
    settings = ["--set", f"name=entries-{os.getpid()}", "--set", "host.program.params.count=12"]
    out = ("--out", folder / "run")
    return folder / "run", read_answer("run", folder / "hosted.toml", *settings, *out)


def test_entries_are_listed_with_their_counts_once_the_bridge_has_reported(
    hosted: Path, rack_name: str, make_segment: MakeSegment
) -> None:
    segment = make_segment(load(hosted, [f"name={rack_name}"]))
    newest = NewestMessages(segment)
    assert [*list_entry_rows(newest)] == []
    writer = open_writer(segment, "bridge.status")
    for entry, counts in (
        ("numbers", {"passed": 7, "refused": 2, "age": 4}),
        ("sum", {"superseded": 3, "full": 5, "waiting": 1, "age": -1}),
    ):
        for name, value in counts.items():
            getattr(writer.message, entry)[name] = value
    writer.write(0)
    writer.close()
    age_ms = 4 * segment.layout.clock_ns * 1e-6
    assert [*list_entry_rows(newest)] == [
        EntryRow("bridge.numbers", "program.numbers", 7, 2, 0, 0, 0, age_ms),
        EntryRow("bridge.sum", "adder.status", 0, 0, 3, 5, 1, None),
    ]


@pytest.mark.thorough
def test_a_replay_of_recorded_entries_repeats_the_run_without_host_boards(
    hosted: Path, rack_name: str, tmp_path: Path, recorded: tuple[Path, dict[str, Any]]
) -> None:
    run, first = recorded
    out = ("--entries", run, "--out", tmp_path / "again")
    again = read_answer("run", hosted, "--set", f"name={rack_name}", *out)
    assert [report["outcome"]["cause"] for report in (first, again)] == ["task done"] * 2
    assert first["digest"] == again["digest"]
    assert first["entries"] == again["entries"]
    assert next(entry["passed"] for entry in first["entries"]) == 12
    assert first["notes"] == again["notes"] == []


@pytest.mark.slow
def test_a_run_with_a_host_board_is_continued_with_its_messages(
    tmp_path: Path, recorded: tuple[Path, dict[str, Any]]
) -> None:
    run, first = recorded
    one = Recording(run)
    tick = int(one.read_signal("bridge.numbers", "tick")[6])
    middle_s = tick * one.layout.clock_ns * 1e-9
    asked = f"--from {run}@{middle_s}"
    done = rack("run", *asked.split(), "--out", tmp_path / "two", "--json")
    assert json.loads(done.stdout)["digest"] == first["digest"]
    assert done.stderr.splitlines() == [
        f"{asked}: not started: 'program'; their recorded messages are replayed",
    ]
    two = Recording(tmp_path / "two")
    assert two.read_signal("bridge.numbers", "tick").min() >= tick
    refusal = read_refusal(rack("run", *asked.split(), "--entries", run))
    assert "--from replays the entries anyway" in refusal


@pytest.mark.slow
def test_entries_of_another_rack_are_refused_in_one_line(
    rack_name: str, tmp_path: Path, recorded: tuple[Path, dict[str, Any]]
) -> None:
    run, _ = recorded
    other = tmp_path / "other.toml"
    text = HOSTED.replace("numbers = {", "others = {")
    other.write_text(text.replace("[host", 'reads.number = "bridge.others"\n\n[host'))
    said = "bridge.others: no such mailbox; needed: number 1, 24 bytes"
    refusal = read_refusal(rack("run", other, "--entries", run, "--no-record"))
    assert refusal == f"--entries {run}: {said}"
    none = rack("run", "k1607", "--set", f"name={rack_name}", "--entries", run, "--no-record")
    assert read_refusal(none) == f"--entries {run}: '{rack_name}' has no adapter"


@pytest.mark.slow
def test_a_prompt_reaches_the_levels_and_a_second_one_is_refused(
    hosted: Path, rack_name: str
) -> None:
    external = ["host.program.external=true", "host.program.program=host_programs:Console"]
    with Rack(load(hosted, [f"name={rack_name}", *external])) as running:
        running.start()
        assert any("--entries RUN repeats a run" in event.text for event in running.events)
        with started("prompt", rack_name, bufsize=1, stderr=None) as first:
            assert first.stdin is not None
            assert first.stdout is not None
            first.stdin.write("number(4)\nprint('sent')\n")
            while "sent" not in first.stdout.readline():
                continue
            why = f"host board 'program' is already running (process {first.pid})"
            assert read_refusal(rack("prompt", rack_name), status=1) == why
            status = rack("status", rack_name).stdout
            assert f"program  {first.pid}  running     1         0" in status
        # A prompt that was killed leaves its place to the next one.
        script = hosted.parent / "more.py"
        script.write_text(
            "number(5)\n"
            "while program.sum.read().message.sum < 9:\n    bus.wait(1.0)\n"
            "bus.finish()\n"
        )
        done = rack("prompt", rack_name, "program", script)
        assert (done.returncode, done.stderr) == (0, "")
        while running.watch(0.5):
            continue
        assert running.outcome is not None
        assert running.outcome.cause == "task done"
