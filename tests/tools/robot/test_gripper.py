"""Tests the grippers that `rack robot new` drafts: one drive and its followers."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.levels.robot.cell import build_cell
from rack.levels.tables import FollowConfig, GripperConfig
from rack.tools.robot.draft import CLOCK_NS, EMPTY_SCENE, Draft
from tests.levels.robot import grippers
from tests.tools.robot.models import drafted, urdf, written

pytestmark = pytest.mark.slow
MOTOR = '<position name="grip_right" joint="finger_right" {}/>'


def gripper_of(made: Draft) -> GripperConfig:
    assert made.robot.gripper is not None, made.notes
    return made.robot.gripper


def test_an_uncoupled_finger_follows_as_a_guess(tmp_path: Path) -> None:
    made = drafted(tmp_path, written(tmp_path, urdf(mimics=False)))
    assert gripper_of(made).follow == (FollowConfig(joint="right_finger", ratio=1.0),)
    assert "right_finger follow" in made.guessed["gripper"]


@pytest.mark.parametrize(
    ("stated", "force"),
    [
        ('forcerange="-15 15"', 15.0),
        # Without a stated force it presses with 20 N besides its friction.
        ("", 20.0 + 3.0),
    ],
)
def test_one_drive_closes_a_hand_of_two_with_the_force_of_both(
    tmp_path: Path, stated: str, force: float
) -> None:
    fingers = grippers.sides(grippers.SLIDE.replace("damping", 'frictionloss="3" damping'))
    motor = MOTOR.format(stated)
    robot, _ = grippers.hand(tmp_path, fingers, grippers.SLIDING, "", actuator=motor)
    gripper = gripper_of(drafted(tmp_path, robot.model))
    assert gripper.follow == (FollowConfig(joint="finger_right", ratio=1.0),)
    assert (gripper.actuator, gripper.joint) == ("grip", "finger_left")
    # The other finger states 60 N, but presses with at most 40 N besides its friction.
    assert gripper.force == 40.0 + 3.0 + force


def test_a_single_finger_closes_on_its_jaw_with_the_tool_next_to_that(tmp_path: Path) -> None:
    robot, _ = grippers.one_finger(tmp_path)
    made = drafted(tmp_path, robot.model)
    gripper = gripper_of(made)
    assert (gripper.joint, gripper.open, gripper.closed) == ("finger_left", 0.04, -0.035)
    assert made.gripper is not None
    fingertips = made.gripper.fingertips
    assert fingertips.has_one_finger
    # The jaw is at y = -35 mm of the hand, the finger opens 75 mm from it.
    assert fingertips.block_width == pytest.approx(0.35 * 0.075)
    beside = -0.035 + 0.5 * fingertips.block_width
    assert fingertips.tool.position[1] == pytest.approx(beside, abs=1e-4)
    assert "finger and fixed jaw" in made.guessed["tool"]


def test_a_finger_that_meets_nothing_is_fixed_with_a_note(tmp_path: Path) -> None:
    robot, _ = grippers.one_finger(tmp_path)
    model = tmp_path / "puma560.xml"
    model.write_text(model.read_text().replace(grippers.FIXED, ""))
    made = drafted(tmp_path, robot.model)
    assert made.robot.gripper is None
    assert "no gripper: the fingers close neither on each other nor on a jaw" in made.notes
    assert [joint.name for joint in made.spec.joints] == list(made.robot.joints)


def test_a_gripper_that_its_arm_blocks_is_fixed(tmp_path: Path) -> None:
    robot, _ = grippers.soft(tmp_path)
    model = tmp_path / "puma560.xml"
    # Of the link before the last: MuJoCo lets fingers and the hand that carries them overlap.
    stop = '<geom class="link" type="cylinder" size=".06 .01" pos="0 .171 0" zaxis="0 1 0"/>'
    model.write_text(model.read_text().replace('<body name="link6"', f'{stop}<body name="link6"'))
    made = drafted(tmp_path, robot.model)
    assert made.robot.gripper is None
    assert made.notes[-1].startswith("no gripper: robot.gripper.force: 2.918 does not move")
    build_cell(made.robot, EMPTY_SCENE, CLOCK_NS)
