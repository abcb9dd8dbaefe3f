"""A hand in a rack of real processes, in lockstep: its board is killed, an object is pushed, the
recording shows it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rack.boards.config import load
from rack.tools.live.display import Display
from rack.tools.live.launch import run_rack
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.report import report_of
from rack.tools.viewer.cell import PUSH_M
from rack.tools.viewer.reading import read
from tests.levels.arms import ROBOTS
from tests.tools.command_line import rack

SECONDS, KILLED_S = 0.5, 0.2
RACK = f"""
format = 2
name = "test-hand-{os.getpid()}"
extends = ["{ROBOTS / "utah_mit.toml"}"]

[clock]
period_ms = 0.5
mode = "lockstep"

[supervision]
lockstep_restart_s = 0.05

[board.hand]
slot = 2
rate_hz = 500
above = "swing"
executor = "rack.levels.systems.hand.executor:HandExecutor"

[board.swing]
slot = 3
rate_hz = 500
below = "hand"
executor = "tests.levels.systems.hand.hand_rig:Swing"

[[scene.push]]
body = "can"
at = 0.1
seconds = 0.2
force = [0.3, 0.0, 0.5]

[[fault]]
kind = "kill"
board = "hand"
at = {KILLED_S}
"""


def ran(folder: Path) -> Recording:
    (folder / "hand.toml").write_text(RACK)
    result = run_rack(load(folder / "hand.toml"), SECONDS, folder / "run", Display())
    assert result.recording == "complete"
    return Recording(folder / "run")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return ran(tmp_path_factory.mktemp("hand"))


@pytest.mark.thorough
@pytest.mark.slow
def test_two_runs_have_one_digest(run: Recording, tmp_path: Path) -> None:
    digest = report_of(run)["digest"]
    assert digest is not None
    assert report_of(ran(tmp_path))["digest"] == digest


@pytest.mark.slow
def test_restarted_board_goes_on_with_the_hand_as_it_was(run: Recording) -> None:
    tick, position, stopped = (
        run.signal("hand.status", name) for name in ("tick", "position", "stopped")
    )
    gap = int(np.diff(tick).argmax())
    assert tick[gap] * 5e-4 == pytest.approx(KILLED_S, abs=0.005)
    assert np.diff(tick).max() * 5e-4 > 0.04
    assert np.abs(position[gap + 1] - position[gap]).max() < 0.05
    assert not stopped[:gap].any()
    assert stopped[gap + 1]
    assert not stopped[-50:].any()  # it follows again
    assert np.abs(position[-1] - position[-50]).max() > 0.01


@pytest.mark.slow
def test_report_says_what_the_tendons_did(run: Recording) -> None:
    hand = report_of(run)["hand"]
    assert hand["violations"] == hand["touches"] == 0
    assert 2.0 <= hand["least_tension_n"] < 15.0 < hand["largest_tension_n"] <= 100.0
    assert hand["largest_force_n"].keys() == {"index", "middle", "ring", "thumb"}
    assert 0 < hand["closed_cycles"] < 20


@pytest.mark.slow
def test_recording_shows_tensions_and_joints_by_finger(run: Recording) -> None:
    file = run.folder / "run.rrd"
    tension, wanted = run.signal("hand.status", "tension"), run.signal("hand.status", "wanted")
    rows = read(file, "/hand/ring/tensions")
    own = slice(8, 12)
    expected = [both[:, row, own] for both in (wanted, tension) for row in (0, 1)]
    assert np.array_equal(rows.values, np.hstack(expected))
    assert np.array_equal(
        read(file, "/hand/thumb/joints").values, run.signal("hand.status", "position")[:, 12:]
    )


@pytest.mark.slow
def test_recording_shows_a_push_as_an_arrow(run: Recording) -> None:
    file = run.folder / "run.rrd"
    vectors = read(file, "/cell/pushes", "Arrows3D:vectors")
    shown = [row for row in vectors.values if row is not None and len(row)]
    assert np.array(shown[0][0]) / PUSH_M == pytest.approx([0.3, 0.0, 0.5], abs=1e-3)
    assert len(shown) == pytest.approx(0.2 / 0.02, abs=3.5)
    assert not len(vectors.values[-1])  # the last message takes the arrow away


@pytest.mark.parametrize(
    ("setting", "why"),
    [
        ("robot.hand.least=200", "robot.hand.rest: 15 N; above robot.hand.least = 200 N is valid"),
        ("robot.hand.flexors=['index0_flexor']", "robot.hand.flexors: 1 values; one per joint: 16"),
        (
            "scene.push=[{ body = 'cup', at = 0, seconds = 1, force = [0, 0, 1] }]",
            "no such object; scene.objects: can",
        ),
    ],
)
def test_check_refuses_what_is_wrong_with_a_hand(tmp_path: Path, setting: str, why: str) -> None:
    (tmp_path / "hand.toml").write_text(RACK)
    found = rack("check", tmp_path / "hand.toml", "--set", setting)
    assert found.returncode == 2
    assert why in found.stderr
    assert found.stderr.count("\n") == 1
