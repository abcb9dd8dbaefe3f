"""The path guard: the arm rests before it touches an obstacle, and continues when it is gone."""

from __future__ import annotations

from itertools import pairwise

import mujoco
import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.messages import SegmentKind, WorldState
from rack.levels.motion.path import BlendedPath
from rack.levels.motion.trajectory import make_trajectory
from rack.levels.primitive.motion_segment import MotionSegment
from rack.levels.primitive.path_guard import PathGuard
from rack.levels.robot.cell import Cell
from rack.levels.tables import MotionConfig
from tests.levels import arms
from tests.levels.primitive.rack import PrimitiveRack, path

CROSSING = "puma560_crossing"
POST = "post"
NEAR = np.array([-0.9, 1.2, -3.1, 0.0, -1.24, 0.0])
"""The arm reaches out next to the wall; turning about its base it sweeps over the table."""
SWEEP = np.array([2.2, 0.0, 0.0, 0.0, 0.0, 0.0])


def crossing(leaves_at: float | None = None) -> list[MotionConfig]:
    """Return a motion of the post: it waits, enters the path of the arm at 1.4 s, and may leave."""
    beside, inside = (0.85, 0.0, 0.8), (0.55, 0.0, 0.8)
    moves = [(0.0, beside, 5.0), (1.4, inside, 0.25)]
    moves += [(leaves_at, beside, 0.25)] if leaves_at else []
    return [MotionConfig(body=POST, at=start, to=to, speed=speed) for start, to, speed in moves]


def sweep(rack: PrimitiveRack) -> None:
    rack.command(path(1, [rack.home, NEAR]), path(2, [NEAR, NEAR + SWEEP]))


@pytest.mark.slow
def test_arm_rests_before_an_obstacle_that_crosses_touches_it() -> None:
    rack = PrimitiveRack(CROSSING, motion=crossing())
    sweep(rack)
    rack.run(3.2)
    assert rack.status.blocked
    assert rack.status.resting
    assert rack.servo.touches == 0
    assert rack.status.done == 1
    # It kept its path, and braked within its limits.
    made = [p for p in rack.set_points if p["due"]]
    accelerations = np.abs([p["acceleration"] for p in made])
    assert (accelerations <= 1.5 * arms.cell(CROSSING).limits.acceleration * (1 + 1e-6)).all()
    last = np.array([p["position"] for p in made[-50:]])
    assert np.ptp(last, axis=0).max() == 0.0
    assert last[0, 1:] == pytest.approx(NEAR[1:], abs=1e-9)


@pytest.mark.slow
def test_a_blocked_arm_continues_when_the_obstacle_has_left() -> None:
    rack = PrimitiveRack(CROSSING, motion=crossing(leaves_at=4.0))
    sweep(rack)
    rack.run(3.0)
    assert rack.status.blocked
    assert rack.status.state == State.HOLDING
    assert "blocked: '" in rack.status.reason
    assert "'post'" in rack.status.reason
    held = rack.status.progress
    assert held > 0.1
    rack.command(path(1, [rack.home, NEAR]), path(2, [NEAR, NEAR + SWEEP]), hold=True)
    rack.run(1.5)
    assert rack.status.blocked
    rack.run(1.5)
    assert not rack.status.blocked
    assert rack.status.resting
    assert rack.status.progress == held
    sweep(rack)
    assert rack.run_until_done(2, 6.0)
    assert rack.servo.touches == 0


class Watched:
    """A guard of a path in the crossing cell, with its world model."""

    def __init__(self, waypoints: np.ndarray, held: int = -1) -> None:
        _, scene = arms.config(CROSSING)
        self.cell: Cell = arms.cell(CROSSING)
        self.guard = PathGuard(self.cell, scene, lookahead_s=2.0, delay_s=0.0, blind_ticks=80)
        self.world = WorldState.zeros({"bodies": len(self.cell.bodies)})
        start = self.cell.build_start_data()
        for row, body in enumerate(self.cell.bodies):
            self.world.position[row] = start.xpos[body]
            self.world.quaternion[row] = start.xquat[body]
        self.path = BlendedPath(waypoints, np.zeros(len(waypoints)))
        self.trajectory = make_trajectory(self.path, self.cell.limits)
        self.segment = MotionSegment.zeros({"joints": len(self.cell.qpos)})
        self.segment.kind = SegmentKind.PATH
        self.segment.object = held

    def watch(self) -> None:
        self.guard.watch_path(self.segment, self.path, 0.04, self.world)

    def clear(self) -> bool:
        """Return True if the path stays clear for 60 cycles in which nothing moves."""
        state = self.path, self.trajectory, 0.0, self.world
        answers = [self.guard.is_clear(*state) for _ in range(60)]
        return all(answers)

    def tool_at(self, q: np.ndarray) -> np.ndarray:
        data = mujoco.MjData(self.cell.model)
        data.qpos[self.cell.qpos] = q
        mujoco.mj_kinematics(self.cell.model, data)
        return data.site_xpos[self.cell.tool].copy()


def test_resting_obstacle_anywhere_on_the_path_is_found() -> None:
    watched = Watched(np.array([NEAR, NEAR + SWEEP]))
    watched.watch()
    assert watched.clear()
    for part in (0.3, 0.6, 0.95):
        watched.world.position[-1, :2] = watched.tool_at(NEAR + part * SWEEP)[:2]
        assert not watched.clear()


def test_an_obstacle_that_moves_into_the_path_is_found_before_it_arrives() -> None:
    watched = Watched(np.array([NEAR, NEAR + SWEEP]))
    watched.watch()
    arrival_s = 0.6 * watched.trajectory.duration
    meets = watched.tool_at(watched.path.evaluate(watched.trajectory.evaluate_at(arrival_s).s).q)
    velocity = np.array([-0.25, 0.0, 0.0])
    watched.world.position[-1] = meets - velocity * arrival_s
    assert watched.clear()
    watched.world.velocity[-1] = velocity
    assert not watched.clear()


def test_work_of_the_guard_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(np.array([NEAR, NEAR + SWEEP, NEAR, NEAR + SWEEP, NEAR]))
    watched.watch()
    checks = []
    free = watched.guard._checker.is_free
    checker = watched.guard._checker
    monkeypatch.setattr(checker, "is_free", lambda *args: checks.append(1) or free(*args))
    counts = [0]
    for _ in range(40):
        watched.guard.is_clear(watched.path, watched.trajectory, 0.0, watched.world)
        counts.append(len(checks))
    assert max(b - a for a, b in pairwise(counts)) <= 13
