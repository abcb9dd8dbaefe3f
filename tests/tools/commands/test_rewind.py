"""Tests `rack rewind`: going to any tick, forwards, backwards or by a condition, and branches."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from rack.boards import Rack
from rack.boards.events import CONTINUATION_CODE
from rack.tools.launch.continued import RepeatedRun
from rack.tools.recording.recording import Recording
from tests.boards.remembering_racks import REMEMBERING
from tests.processes import descriptors
from tests.shared_runs import run_text
from tests.tools.command_line import rack

pytestmark = pytest.mark.slow
SECONDS = 1.25
DIGITS = "9" * 400


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 500 ticks."""
    return run_text(tmp_path_factory, REMEMBERING, SECONDS)


class Asked:
    """Sends lines to `rack rewind --json`. `status` is the exit status of the last call."""

    def __init__(self, run: Path, patch: pytest.MonkeyPatch) -> None:
        self._run = run
        self._patch = patch
        self.status = 0

    def __call__(self, *lines: str) -> list[dict[str, Any]]:
        self._patch.setattr(sys, "stdin", StringIO("\n".join(lines)))
        done = rack("rewind", self._run, "--json")
        self.status = done.returncode
        assert not done.stderr
        return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.fixture
def asked(run: Path, monkeypatch: pytest.MonkeyPatch) -> Asked:
    """Sends lines to a prompt on the run."""
    return Asked(run, monkeypatch)


def test_any_tick_is_reached_and_its_messages_shown(run: Path, asked: Asked) -> None:
    found = asked(
        *("goto 1.2", "show wave.status", "show wave.status.value", "step", "step 10", "back 3"),
        *("show wave.status", "goto 0", "back", "show wave.status", "quit", "goto 1"),
    )
    value = dict(
        zip(*(Recording(run).read_signal("wave.status", n) for n in ("tick", "value")), strict=True)
    )
    assert found[0] == {"tick": 480, "time_s": 1.2}
    first = found[1]["value"]
    assert (first["tick"], first["age_ticks"], first["serial"]) == (479, 1, 480)
    assert first["fields"]["value"] == found[2]["value"] == value[479]
    assert [one["tick"] for one in found[3:6]] == [481, 491, 488]
    assert found[6]["value"]["fields"]["value"] == value[487]
    assert found[8]["error"].startswith("-0.0025: must be 0 to 1.2475 s")
    assert "wave.status: no message yet at 0 s" in found[9]["error"]
    # Nothing is done after quit.
    assert len(found) == 10
    assert asked.status == 2


def test_a_condition_is_found_forwards_and_backwards(run: Path, asked: Asked) -> None:
    ticks, value = (Recording(run).read_signal("wave.status", name) for name in ("tick", "value"))
    limit = float(value[300]) + 1.0
    held = value > limit
    begins = ticks[held & ~held.astype(bool).take(range(-1, len(held) - 1))] + 1
    begins = begins[begins > 1].tolist()
    condition = f'--when "wave.status.value > {limit!r}"'
    found = asked(*(f"goto {condition}" for _ in range(len(begins) + 1)), f"back {condition}")
    assert [one["tick"] for one in found[: len(begins)]] == begins
    assert "does not begin to hold after" in found[len(begins)]["error"]
    if len(begins) > 1:
        assert found[-1]["tick"] == begins[-2]
    else:
        assert "does not begin to hold before" in found[-1]["error"]


def test_a_level_is_shown_as_it_was_at_that_tick(asked: Asked) -> None:
    found = asked("goto 1.2", "show wave", "goto 1", "show wave", "goto 0.3", "show wave")
    for one, tick in zip(found[1::2], (480, 400, 120), strict=True):
        assert one["value"]["_recent"] == [before % 7 for before in range(tick - 5, tick)]


def test_later_ticks_continue_from_the_nearest_reached_tick(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[int] = []
    rack_at = RepeatedRun.run_rack_to

    @contextmanager
    def noted(self: RepeatedRun, *asked: Any) -> Iterator[Rack]:
        with rack_at(self, *asked) as ran:
            # The tick of the snapshot from which it continued, or -1 without one.
            snapshots = (one.tick for one in ran.events if one.code == CONTINUATION_CODE)
            begun.append(next(snapshots, -1))
            yield ran

    monkeypatch.setattr(RepeatedRun, "run_rack_to", noted)
    recording = Recording(run)
    before = descriptors()
    with RepeatedRun(recording) as again:
        levels = [again.read_levels(tick) for tick in (450, 470, 450, 460)]
    assert (begun[0], begun[2]) == (-1, 450)
    # None at which there is a snapshot runs again.
    assert len(begun) == 3
    assert begun[1] >= 450
    assert levels[0] == levels[2]
    assert descriptors() == before
    with RepeatedRun(Recording(run)) as alone:
        assert alone.read_levels(470) == levels[1]


def test_a_branch_differs_only_after_its_tick_and_only_if_changed(
    run: Path, asked: Asked, tmp_path: Path
) -> None:
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    same, other = tmp_path / "same", tmp_path / "other"
    found = asked(
        "goto 1.2",
        f"branch --seconds {SECONDS} --out {same}",
        f"branch --set board.wave.params.factor=2 --seconds {SECONDS} --out {other}",
        f"branch --out {other}",
        "branch --set board.wave.parms.factor=2",
    )
    expected = Recording(run).end_counts["outcome"]["digest"]
    assert (found[1]["first_difference"], found[1]["outcome"]["digest"]) == (None, expected)
    assert found[2]["first_difference"] == {"tick": 480, "mailbox": "wave.status"}
    assert Recording(other).read_signal("wave.status", "tick")[0] == 480
    assert "exists already" in found[3]["error"]
    assert "board.wave.parms = " in found[4]["error"]
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


@pytest.mark.thorough
def test_a_branch_may_begin_while_a_cycle_is_late(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault = 'fault=[{ kind = "overrun", board = "watch", tick = 100, for = 0.25, by = 2.0 }]'
    run = run_text(tmp_path_factory, REMEMBERING, 0.5, fault)
    # The cycle that was released at tick 104 ends after tick 110.
    branch = run.with_name("branch")
    found = Asked(run, monkeypatch)("goto 0.275", f"branch --out {branch}")[-1]
    expected = Recording(run).end_counts["outcome"]["digest"]
    assert found["outcome"]["digest"] == expected
    assert found["first_difference"] is None
    assert min(Recording(branch).cycles["watch"]["tick"]) == 104


def test_a_mistake_is_reported_in_one_line_with_the_usage(asked: Asked) -> None:
    lines = {
        "goot 3": "goot: no such command; nearest: goto",
        "goto": 'goto: usage: goto TIME, as in 12.5; or goto --when "',
        "goto soon": "soon: must be 0 to 1.2475 s",
        "goto nan": "nan: must be 0 to 1.2475 s",
        "step x": "step: argument ticks: x: must be -1000000000000000 to 1000000000000000 ticks",
        f"step {DIGITS}": f"{DIGITS[:40]}",
        f"back -{DIGITS}": "must be -1000000000000000 to 1000000000000000 ticks",
        f"goto {DIGITS}": "must be 0 to 1.2475 s",
        f"goto -{DIGITS}": "must be 0 to 1.2475 s",
        f"events {DIGITS}": "must be 0 to 1e+09 s",
        f"branch --seconds {DIGITS}": "must be 0 to 1e+09 s",
        f"branch --set seed={DIGITS}": "integer too long: the limit is 64 bits",
        f"show wave.status.value[{DIGITS}]": "no such signal; nearest: wave.status.value",
        f"show wave.status.value[{12 * DIGITS}]": "wave.status.value[9",
        'goto --when "wave.status.valeu > 1"': "nearest: wave.status.value",
        "show wavf": "wavf: no such level, mailbox or signal; nearest: wave",
        "show wave.status.value[3]": "no such index",
        "events -1": "-1: must be 0 to 1e+09 s",
        'show "wave': "No closing quotation",
        "help got": "got: no such command; nearest: goto",
    }
    found = asked(*lines, "", "# a comment", "help goto")
    assert [why in one["error"] for why, one in zip(lines.values(), found, strict=False)] == [
        True
    ] * len(lines), found
    assert "begins to hold" in found[-1]["help"]
    assert len(found) == len(lines) + 1
    assert asked.status == 2
    asked("goto 1", "events 2")
    assert asked.status == 0


def test_a_script_without_json_prints_text(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", StringIO("goto 1.2\nshow wave.status.value\nevents 5\nhelp"))
    done = rack("rewind", run)
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    assert lines[0] == "1.2 s, tick 480"
    assert lines[1].startswith("wave.status.value = ")
    assert any("time over after 500 ticks" in line for line in lines)
    assert rack("rewind", run.parent).returncode == 2
