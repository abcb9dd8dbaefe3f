"""What `rack robot new` makes of grippers: one drive, and what follows it."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.levels.tables import FollowConfig, GripperConfig
from rack.tools.robot.draft import Draft, Wishes, draft
from rack.tools.robot.source import read_source
from tests.levels.robot import grippers
from tests.tools.robot.models import urdf, written

pytestmark = pytest.mark.slow
MOTOR = '<position name="grip_right" joint="finger_right" forcerange="-15 15"/>'


def drafted(folder: Path, model: Path) -> Draft:
    return draft(read_source(model), Wishes(), folder, "drafted")


def gripper_of(made: Draft) -> GripperConfig:
    assert made.robot.gripper is not None, made.notes
    return made.robot.gripper


def test_a_finger_that_nothing_couples_follows_and_that_is_a_guess(tmp_path: Path) -> None:
    made = drafted(tmp_path, written(tmp_path, urdf(mimics=False)))
    assert gripper_of(made).follow == (FollowConfig(joint="right_finger", ratio=1.0),)
    assert "right_finger follow" in made.guessed["gripper"]


def test_a_finger_that_mimics_needs_no_entry(tmp_path: Path) -> None:
    made = drafted(tmp_path, written(tmp_path, urdf()))
    assert gripper_of(made).follow == ()
    assert "gripper" not in made.guessed


def test_one_drive_closes_a_hand_of_two_with_the_force_of_both(tmp_path: Path) -> None:
    fingers = grippers.sides(grippers.SLIDE)
    robot, _ = grippers.hand(tmp_path, fingers, grippers.SLIDING, "", MOTOR)
    gripper = gripper_of(drafted(tmp_path, robot.model))
    assert gripper.follow == (FollowConfig(joint="finger_right", ratio=1.0),)
    assert (gripper.actuator, gripper.joint) == ("grip", "finger_left")
    assert gripper.force == 40.0 + 15.0


def test_soft_tendons_that_stay_within_the_residual_are_accepted(tmp_path: Path) -> None:
    robot, _ = grippers.soft(tmp_path)
    made = drafted(tmp_path, robot.model)
    assert gripper_of(made).follow == ()
    gripper = made.cell().gripper
    assert gripper is not None
    assert gripper.linkage.yields


def test_a_single_finger_is_held_and_the_reason_said(tmp_path: Path) -> None:
    robot, _ = grippers.one_finger(tmp_path)
    made = drafted(tmp_path, robot.model)
    assert made.robot.gripper is None
    assert "no gripper: one finger, or fingers that do not close on each other" in made.notes
    assert [joint.name for joint in made.spec.joints] == list(made.robot.joints)
