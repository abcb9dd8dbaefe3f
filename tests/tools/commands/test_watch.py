"""Tests `rack watch` and `rack mailbox` on running racks: they show what was written."""

from __future__ import annotations

import csv
import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from pathlib import Path

import pytest

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.commands import watch
from rack.tools.commands.step import Stepper
from tests.processes import in_thread, wait_until
from tests.tools.command_line import rack, read_answer, read_refusal
from tests.tools.held_racks import held_rack


@contextmanager
def held_before_tick_20(folder: Path, name: str) -> Iterator[str]:
    """Hold a counting rack, and yield its name."""
    with held_rack(folder, name):
        assert rack("step", name, "--ticks", "20").returncode == 0
        yield name


@pytest.fixture
def held(rack_name: str, tmp_path: Path) -> Iterator[str]:
    """Name of a counting rack that a test may continue."""
    with held_before_tick_20(tmp_path, rack_name) as name:
        yield name


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Name of a counting rack that stays held."""
    folder = tmp_path_factory.mktemp("still")
    with held_before_tick_20(folder, f"test-still-{os.getpid()}") as name:
        yield name


@pytest.mark.slow
def test_mailboxes_are_listed_and_their_newest_messages_shown(still: str) -> None:
    listed = read_answer("mailbox", still)
    (counter,) = [row for row in listed if row["mailbox"] == "counter.status"]
    assert (counter["writer"], counter["period_ms"], counter["written"]) == ("counter", 10.0, 5)
    assert "counter.status" in rack("mailbox", still).stdout
    newest = read_answer("mailbox", still, "counter.status")
    # Released at ticks 0, 4, ..., 16; the rack is at tick 19.
    assert (newest["serial"], newest["tick"], newest["age_ticks"]) == (5, 16, 3)
    assert newest["fields"]["fired"] == "count up"
    assert newest["fields"]["state"] == "executing"
    text = rack("mailbox", still, "counter.status").stdout
    assert text.startswith("counter.status: serial 5, of tick 16, 3 ticks (7.5 ms) old\n")


@pytest.mark.slow
def test_an_unknown_name_is_reported_in_one_line(still: str, tmp_path: Path) -> None:
    call, row = ("watch", still), "counter.status.row"
    never = (*call, row, "--when", f"{row} > 99")
    cases = {
        ("mailbox", still, "counter.stat"): "counter.stat: no such mailbox; nearest: coun",
        ("mailbox", still, "--watch"): "--watch needs the NAME of a mailbox",
        (*call, "counter.status.rwo"): "counter.status.rwo: no such signal; nearest: ",
        (*call, row, "--out", "x.csv"): "--out needs --when; give both",
        (*call, row, "--every", "1"): "--every 1: must be a time, ",
        (*call, row, "--after", "9e3s"): "--after 9e3s: must be a time, ",
        (*never, "--out", "missing/x.csv"): '"missing/x.csv": No such file or directory',
        (*never, "--out", "."): '".": Is a directory',
        (*call, row, "--when", f"{row} > nan"): f'"{row} > nan": nothing can be compared with nan',
    }
    for words, why in cases.items():
        assert read_refusal(rack(*words, folder=tmp_path)).startswith(why)
    assert [*tmp_path.glob("*.csv")] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "options", "count", "step"),
    [
        ("watch", ("counter.status.fired", "--every", "0s"), "tick", 4),
        ("mailbox", ("counter.status", "--watch"), "serial", 1),
    ],
)
def test_every_message_is_shown_until_the_run_ends(
    held: str, command: str, options: tuple[str, ...], count: str, step: int
) -> None:
    with in_thread(lambda: go_on(held, "count down")):
        done = rack(command, held, *options, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    counts = [json.loads(line)[count] for line in done.stdout.splitlines()]
    assert counts == [*range(counts[0], counts[-1] + 1, step)]
    assert "count up" in done.stdout
    assert "count down" in done.stdout


@pytest.mark.slow
def test_a_window_around_a_trigger_is_saved(held: str, tmp_path: Path) -> None:
    signals = ("counter.status.fired", "watch.status.state")
    condition = "counter.status.row == 4"
    words = ("--when", condition, "--before", "50ms", "--after", "30ms")
    with in_thread(lambda: go_on(held, '"rows"')):
        found = read_answer("watch", held, *signals, *words, folder=tmp_path)
    saved = (tmp_path / f"{held}-{found['tick']}.csv").read_text()
    head, *rows = csv.reader(saved.splitlines())
    assert head == ["time, s", "tick", *signals]
    assert len(rows) == found["rows"]
    # It turns in its 4th row; clock 2.5 ms, a message every 10 ms.
    ticks = [int(row[1]) for row in rows]
    assert ticks == [*range(found["tick"] - 20, found["tick"] + 13, 4)]
    assert [row[2] for row in rows][5] == "turn"
    assert "turn" not in [row[2] for row in rows][:5]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "ticks", "said"),
    [
        (
            ("counter.status.row == 4", "--after", "30ms", "--out", "/dev/full"),
            8000,
            "/dev/full: No space left on device: cut off",
        ),
        (
            ("counter.status.row > 99",),
            800,
            "rack '{}': the condition has not held; the run is over",
        ),
    ],
    ids=["full disk", "never"],
)
def test_a_trigger_that_fails_or_does_not_fit_is_reported(
    held: str, words: tuple[str, ...], ticks: int, said: str
) -> None:
    with in_thread(lambda: go_on(held, None, ticks)):
        done = rack("watch", held, "counter.status.fired", "--when", *words)
    assert read_refusal(done, status=1) == said.format(held)


def go_on(name: str, until: str | None, ticks: int = 8000) -> None:
    """Wait for a command to begin, then step a rack by 8 ticks until the command has printed a text
    or ended, up to a number of ticks, and end the rack's run."""
    stepper = Stepper(Segment.attach(name))
    tick = stepper.hold_rack()
    # Before the command begins, and after its end, stdout is pytest's.
    wait_until(lambda: isinstance(sys.stdout, StringIO))
    for step in range(0, ticks, 8):
        out = sys.stdout
        if not isinstance(out, StringIO) or (until is not None and until in out.getvalue()):
            break
        stepper.run_to(tick + step + 8)
        time.sleep(0.002)
    Segment.attach(name).words[System.STOP_REQUEST] = 1


def test_times_are_accepted_in_all_units() -> None:
    found = [watch._parse_seconds("--every", text) for text in ("20ms", "0.5s", "2 min")]
    assert found == [0.02, 0.5, 120.0]
