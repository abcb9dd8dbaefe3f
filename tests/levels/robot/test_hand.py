"""A hand, from its description alone; every mistake in it is reported in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from rack.levels.errors import RobotError
from rack.levels.robot.cell import Cell, build_cell, compute_sizes
from rack.levels.tables import RobotConfig
from tests.levels.arms import ROBOTS, config

CLOCK_NS = 500_000
FLEXOR = '<general class="tendon" name="index0_flexor" tendon="index0_flexor"/>'
TENDON = '<fixed name="index0_flexor"><joint joint="index0" coef="-.012"/></fixed>'
NO_TENSION = (
    "actuator 'index0_flexor' must pull one tendon, with its control as tension, N: it needs a"
    " fixed gain of 1, no bias, a gear of -1, and a range from 0 or more to above robot.hand.least = 2"
)
EXTENSOR = '<fixed name="index0_extensor"><joint joint="index0" coef=".012"/></fixed>'


def build(robot: RobotConfig) -> Cell:
    return build_cell(robot, config("utah_mit")[1], CLOCK_NS)


def test_the_hand_has_four_fingers_and_sixteen_joints_with_two_tendons_each() -> None:
    made = build(config("utah_mit")[0])
    hand = made.hand
    assert hand is not None
    assert compute_sizes(made)["fingers"] == 4
    assert compute_sizes(made)["joints"] == 16
    assert len(np.unique(hand.actuators)) == 32 == made.model.nu
    assert (hand.fingers.sum(axis=0) == 1).all()
    assert (hand.fingers.sum(axis=1) == 4).all()
    assert hand.arms == pytest.approx([0.012, 0.012, 0.010, 0.008] * 4)
    assert made.bounds.torque == pytest.approx(hand.arms * 98.0)


def test_a_tension_turns_its_joint_and_no_other() -> None:
    made = build(config("utah_mit")[0])
    assert made.hand is not None
    data = made.build_start_data()
    for row, sign in enumerate((1.0, -1.0)):
        for joint, actuator in enumerate(made.hand.actuators[row]):
            data.act[:] = 0.0
            data.act[made.model.actuator_actadr[actuator]] = 10.0
            mujoco.mj_forward(made.model, data)
            torque = np.zeros(16)
            torque[joint] = sign * 10.0 * made.hand.arms[joint]
            assert data.qfrc_actuator[made.dof] == pytest.approx(torque)


def test_the_palm_belongs_to_the_hand_and_may_touch_what_it_holds() -> None:
    made = build(config("utah_mit")[0])
    names = ("palm", "can", "stand", "index_pad", "thumb_pad")
    geom = {name: made.model.geom(name).id for name in names}
    assert not made.geoms.touch[geom["palm"], geom["can"]]
    assert not made.geoms.touch[geom["index_pad"], geom["thumb_pad"]]
    assert not made.geoms.touch[geom["can"], geom["stand"]]
    assert made.geoms.touch[geom["index_pad"], geom["stand"]]


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (FLEXOR, FLEXOR.replace("/>", ' ctrlrange="-100 100"/>'), NO_TENSION),
        (FLEXOR, FLEXOR.replace("/>", ' gear="1"/>'), NO_TENSION),
        (FLEXOR, FLEXOR.replace("/>", ' ctrlrange="0 2"/>'), NO_TENSION),
        (FLEXOR, FLEXOR.replace("/>", ' ctrllimited="false"/>'), NO_TENSION),
        (FLEXOR, FLEXOR.replace("/>", ' gainprm="2"/>'), NO_TENSION),
        (FLEXOR, FLEXOR.replace("/>", ' biastype="affine"/>'), NO_TENSION),
        (FLEXOR, FLEXOR.replace("/>", ' ctrlrange="0 90"/>'), "joint 'index0' pull at most 90 and 100 N"),
        (FLEXOR, FLEXOR.replace(' tendon="index0_flexor"', ' joint="index0"'), NO_TENSION),
        (TENDON, TENDON.replace("-.012", "0"), "on joint 'index0' are 0 to 0.012 m"),
        (TENDON, TENDON.replace("-.012", ".012"), "on joint 'index0' are -0.012 to 0.012 m"),
        (EXTENSOR, EXTENSOR.replace(".012", "-.012"), "on joint 'index0' are -0.012 to 0.012 m"),
        (EXTENSOR, EXTENSOR.replace(".012", ".010"), "on joint 'index0' are 0.01 to 0.012 m"),
        (TENDON, TENDON.replace("</fixed>", '<joint joint="index1" coef=".01"/></fixed>'), "on joint 'index0' are 0.012 to 0.012 m, and on others up to 0.01 m")
    ],
)  # fmt: skip
def test_a_tendon_without_a_pair_is_refused(tmp_path: Path, old: str, new: str, why: str) -> None:
    text = (ROBOTS / "utah_mit.xml").read_text()
    assert text.count(old) == 1, old
    (tmp_path / "hand.xml").write_text(text.replace(old, new))
    robot = config("utah_mit")[0].model_copy(update={"model": tmp_path / "hand.xml"})
    with pytest.raises(RobotError, match=r"robot\.hand") as refused:
        build(robot)
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("what", "why"),
    [
        ({"least": 15.0}, "robot.hand.rest: 15 N must be above robot.hand.least, 15 N"),
        ({"rest": 100.0}, "robot.hand.rest: 100 N must be below the largest tension, 100 N"),
        ({"flexors": ("one",)}, "robot.hand.flexors: has 1 values but needs 16, one per joint"),
    ],
)
def test_tensions_and_lists_that_do_not_fit_are_refused(what: dict[str, Any], why: str) -> None:
    robot = config("utah_mit")[0]
    assert robot.hand is not None
    hand = robot.hand.model_copy(update=what)
    with pytest.raises(RobotError, match=why):
        build(robot.model_copy(update={"hand": hand}))


def test_a_hand_has_no_gripper_and_no_torque_limits() -> None:
    robot = config("utah_mit")[0]
    why = r"robot\.torque: torques of a hand follow from its tendons"
    with pytest.raises(RobotError, match=why):
        build(robot.model_copy(update={"torque": (1.0,) * 16}))
