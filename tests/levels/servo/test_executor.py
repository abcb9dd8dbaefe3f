"""The servo level: follows, holds, and survives faults of other levels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.algebra import Array
from rack.levels.messages import Error
from rack.levels.robot.dynamics import Dynamics
from rack.levels.servo.curves import Bridge, Curve
from rack.levels.tables import SceneConfig
from tests.levels.arms import ROBOTS, cell, config
from tests.levels.servo.rig import HOME, PERIOD, TICK_S, Course, ServoRig

GOALS = {
    "puma560": [0.6, 1.0, -2.6, 0.4, -1.2, 0.5],
    "k1607": [0.6, -0.5, 0.3, -1.2, 0.4, -0.5, 0.5],
}


def course(name: str) -> Course:
    return Course(np.array(config(name)[0].home), np.array(GOALS[name]), 2.0)


def steps_of(values: list[Array]) -> Array:
    """Return the second differences over time, rad/s2, (n, joints)."""
    return np.asarray(np.diff(np.array(values), n=2, axis=0)) / TICK_S**2


def test_a_bridge_needs_most_acceleration_at_its_ends() -> None:
    rest = Curve(np.zeros(2), duration_s=1.0)
    bridge = Bridge(rest, 0.5, (np.array([1.0, 0.0]), np.zeros(2)), duration_s=1.0)
    assert bridge.compute_motion(0.5).position == pytest.approx([0.5, 0.0])
    assert [bridge.is_within(np.full(2, most)) for most in (5.9, 6.1)] == [False, True]


@pytest.mark.parametrize("name", GOALS)
def test_a_two_second_move_is_followed_within_a_third_of_a_milliradian(name: str) -> None:
    rig, move = ServoRig(*config(name)), course(name)
    rig.run(900, move.at)
    errors = rig.errors(move.at)
    assert np.abs(errors).max() < 0.33e-3
    assert np.sqrt(np.mean(errors**2)) < 0.1e-3
    # The set points' own peak is 2.1 rad/s2: there is no jump in velocity.
    assert np.abs(steps_of(rig.targets)).max() < 4.0
    assert rig.status.state == State.EXECUTING
    assert (rig.status.clipped, rig.status.touches, rig.status.error) == (0, 0, Error.NONE)


def test_when_set_points_stop_the_motion_ramps_to_rest_within_the_acceleration_limits() -> None:
    rig, move = ServoRig(*config("puma560")), course("puma560")
    limits = np.array(config("puma560")[0].acceleration)
    rig.run(400, move.at)
    speed = np.abs(rig.status.target_velocity).max()
    rig.run(400)
    assert speed > 0.3
    assert rig.status.holding == 1
    assert rig.status.target_velocity.tolist() == [0.0] * 6
    assert (np.abs(steps_of(rig.targets[400:])) <= limits * 1.01).all()
    assert np.abs(rig.status.position - rig.status.target).max() < 1e-3
    assert rig.status.clipped == 0


def test_a_restarted_servo_finds_the_arm_where_it_was() -> None:
    rig, move = ServoRig(*config("puma560")), course("puma560")
    rig.run(400, move.at)
    before = rig.status.position.copy()
    rig.rack.restart("servo")
    rig.run(1)
    assert rig.status.position == pytest.approx(before, abs=0.01)
    assert np.abs(rig.status.velocity).max() > 0.2
    rig.run(600, move.at)
    assert rig.status.position == pytest.approx(move.goal, abs=1e-3)
    assert rig.state.tick == rig.rack.tick - 1


STILL = np.zeros(6)
GARBAGE = {
    "nan": (HOME * np.nan, STILL),
    "nan velocity": (HOME, STILL * np.nan),
    "far": (HOME + 100.0, STILL),
    "fast": (HOME, STILL + 1e6),
    "jump": (HOME + 0.4, STILL),
}


@pytest.mark.parametrize("kind", GARBAGE)
def test_a_broken_set_point_neither_breaks_a_limit_nor_the_arm(kind: str) -> None:
    (robot, _), rig = config("puma560"), ServoRig(*config("puma560"))
    wrong = GARBAGE[kind]
    for _ in range(25):
        rig.run(PERIOD, lambda _: wrong)
        assert (np.abs(rig.status.velocity) <= robot.velocity).all()
        assert np.isfinite(rig.status.position).all()
    assert rig.status.error in (Error.NONE, Error.TOUCHED)  # "far" leads into the table
    assert kind == "jump" or rig.status.clipped > 0
    if kind in ("nan", "fast"):
        # Good ones are followed again.
        goal = course("puma560").goal
        rig.run(1600, lambda _: (goal, STILL))
        assert rig.status.position == pytest.approx(goal, abs=1e-3)


def test_a_set_point_due_in_the_far_future_is_refused() -> None:
    rig = ServoRig(*config("puma560"))
    rig.run(PERIOD)
    rig.set_point(rig.status.position + 0.2, np.zeros(6), 10**12)
    rig.run(20)
    assert rig.status.holding == 1
    assert rig.status.clipped == 20


WEIGHT = """
<body name="weight" pos=".499 -.15 .835">
  <freejoint/>
  <geom name="weight" type="box" size=".025 .025 .025" mass="1.5" friction="1 .02 .001" condim="4"/>
</body>
"""


def test_the_held_object_is_in_the_plan_and_does_not_pull_the_arm_down(tmp_path: Path) -> None:
    # The gripper closes on a weight that starts to fall between the fingers.
    robot, _ = config("puma560")
    model = tmp_path / "weight.xml"
    text = (ROBOTS / "puma560.xml").read_text()
    model.write_text(text.replace("<worldbody>", f"<worldbody>{WEIGHT}", 1))
    grasping = ServoRig(robot.model_copy(update={"model": model}), SceneConfig(objects=("weight",)))
    grasping.command.opening, grasping.command.force, grasping.command.held = 0.0, 40.0, 0
    grasping.run(400, lambda _: (HOME, STILL))
    plan, scene = grasping.rack.read("servo.plan"), grasping.rack.read("servo.scene")
    assert (plan.held, plan.payload_mass) == (0, pytest.approx(1.5))
    assert plan.payload_offset == pytest.approx([0, 0, 0.0], abs=0.01)
    assert scene.position[0] == pytest.approx(scene.tool_position, abs=0.01)
    assert grasping.status.opening == pytest.approx(0.025, abs=1e-3)
    assert grasping.status.grip_force == -40.0
    assert grasping.status.touches == 0
    bare = Dynamics(cell("puma560")).terms(HOME, STILL).bias
    lifted = grasping.status.torque[1] - bare[1]
    assert lifted == pytest.approx(1.5 * 9.81 * 0.5, rel=0.05)
    # A restart does not drop it.
    grasping.miss(10_000)
    for _ in range(100):
        grasping.rack.step()
    grasping.rack.restart("servo")
    grasping.run(200)
    scene = grasping.rack.read("servo.scene")
    assert scene.position[0] == pytest.approx(scene.tool_position, abs=0.01)
    assert grasping.status.touches == 0
