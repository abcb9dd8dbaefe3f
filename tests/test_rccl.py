"""The rack rccl, with real processes in lockstep: its planner stalls, and the arm finishes its
queue and holds; two arms begin their motions together."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.message import State
from rack.boards.config import CONFIGS, load
from rack.tools.recording.recording import Recording
from tests.processes import RACK
from tests.shared_runs import record
from tests.warm import run_command

pytestmark = [pytest.mark.thorough, pytest.mark.timeout(240)]

SECONDS = 6.0
HANG_TICK = 1500
STALL_TICKS = 2000
"""Of the planner: half a second until the hang is found, and 1.5 s until it is back."""


def test_a_planner_that_stalls_for_2_s_leaves_the_arm_to_finish_its_queue_and_hold(
    tmp_path: Path,
) -> None:
    config = load("rccl/stalled-planner", [f"name=test-rccl-{os.getpid()}", "clock.mode=lockstep"])
    run = record(config, SECONDS, tmp_path / "run")
    plans = run.read_trace("planning.planner")["tick"]
    gap = int(np.diff(plans).argmax())
    assert plans[gap] < HANG_TICK
    assert plans[gap + 1] == pytest.approx(HANG_TICK + STALL_TICKS, abs=200)
    tick, done, resting, state = (
        run.read_signal("trajectory.status", name) for name in ("tick", "done", "resting", "state")
    )
    # Two requests are open when the planner stops: one under way, the other queued.
    assert done[tick == HANG_TICK] == 0
    stalled = (tick >= 2900) & (tick < HANG_TICK + STALL_TICKS)
    assert (done[stalled] == 2).all()
    assert resting[stalled].all()
    assert (state[stalled] == State.DONE).all()
    assert done[-1] >= 4
    position, target, violations, touches = (
        run.read_signal("arm.status", name)
        for name in ("position", "target", "violations", "touches")
    )
    assert np.abs(position - target).max() < 2e-3
    assert violations[-1] == touches[-1] == 0
    steps = np.diff(target[10:], 2, axis=0)
    # rad/s2: twice the greatest acceleration of a joint.
    assert np.abs(steps).max() * 1e6 < 2.0 * 12.0
    assert np.abs(np.diff(target[10:], axis=0)).max() > 2e-4


ARMS = ("left", "right")
MOST_S = 200.0
"""Longest time of a run of both racks, 26 processes in lockstep, on a busy machine."""
KILLED = """
[[fault]]
kind = "kill"
board = "trajectory"
at = 1.9
"""
DEAF = """
[[fault]]
kind = "mute"
board = "lan"
mailbox = "lan.meeting"
at = 2.0
for = 0.5
"""


def run_two_arms(folder: Path, faults: Mapping[str, str]) -> dict[str, Recording]:
    """Run two arms to the ends of their programs, with faults by arm, and return the recordings."""
    name = f"test-{os.getpid()}-{folder.name[-12:].replace('_', '-')}"
    for arm in ARMS:
        text = (CONFIGS / "rccl" / f"{arm}.toml").read_text()
        text = text.replace("rccl-", f"{name}-").replace("rccl_", f"{name.replace('-', '_')}_")
        text = text.replace('"two-arms.toml"', f'"{CONFIGS / "rccl" / "two-arms.toml"}"')
        (folder / f"{arm}.toml").write_text(text + faults.get(arm, ""))
    command = [*RACK, "run", "left.toml", "--out", "left", "--share"]
    done = run_command(command, MOST_S, cwd=folder, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    (right,) = (folder / "runs").iterdir()
    return {"left": Recording(folder / "left"), "right": Recording(right)}


def find_starts(run: Recording) -> list[int]:
    """Return the ticks at which an arm begins to move after its meetings."""
    tick, resting = (run.read_signal("trajectory.status", name) for name in ("tick", "resting"))
    meeting_tick, begun = (
        run.read_signal("trajectory.meeting", name) for name in ("tick", "begun")
    )
    met = meeting_tick[np.flatnonzero(np.diff(begun, prepend=0))]
    return [int(tick[(tick >= at) & (resting == 0)][0]) for at in met]


@pytest.mark.parametrize(
    ("faults", "late_s"),
    [
        # It returns with its queue and its arrival, while the left arm waits.
        pytest.param({"right": KILLED}, 0.0, id="level killed"),
        # The left arm learns at 2.54 s of the right one's arrival, and should have begun at 2.16 s.
        pytest.param({"left": DEAF}, 0.38, id="link out"),
    ],
)
def test_two_arms_with_queues_of_their_own_begin_their_motions_in_the_same_tick(
    faults: dict[str, str], late_s: float, tmp_path: Path
) -> None:
    runs = run_two_arms(tmp_path, faults)
    left, right = (find_starts(runs[arm]) for arm in ARMS)
    assert len(left) == len(right) == 2
    assert (left[0] - right[0]) * 1e-3 == pytest.approx(late_s, abs=0.05)
    if not late_s:
        assert left[0] == right[0]
    assert left[1] == right[1]
    late, number = (runs["left"].read_signal("trajectory.meeting", f) for f in ("late", "number"))
    assert late.max() == pytest.approx(late_s, abs=0.05)
    assert number[-1] == 2
    waited = {}
    for arm, run in runs.items():
        arrived, start = (run.read_signal("trajectory.meeting", f) for f in ("arrived", "start"))
        waited[arm] = float(start[-1] - arrived[-1])
        assert run.read_signal("arm.status", "violations")[-1] == 0
        queued = run.read_signal("trajectory.status", "taken")
        assert queued[-1] == len(run.rack_config.task["step"])
    # At the second meeting the left arm arrives last, and the right one waits for it.
    assert waited["left"] == pytest.approx(0.1, abs=0.021)
    assert waited["right"] > 0.5


def test_a_trajectory_level_without_a_partner_refuses_to_meet(tmp_path: Path) -> None:
    settings = [f"name=test-alone-{os.getpid()}", "clock.mode=lockstep", "task.step=[{do='meet'}]"]
    run = record(load("rccl", settings), SECONDS, tmp_path / "run")
    reasons = run.read_signal("trajectory.status", "reason")
    assert "kind 8; permitted: 1 to 5" in str(reasons[-1])
