"""Couplings of a model: a joint of the arm that is tied to anything is refused by its name."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.levels.errors import RobotError
from rack.levels.robot.cell import build_cell
from rack.levels.tables import RobotConfig, SceneConfig
from tests.levels.arms import CLOCK_NS, MOTORS, pendulum

POST = '<site name="post" pos="0 0 1"/>'
TARGET = '<body name="target" mocap="true" pos=".75 0 .7"/>'
FLAP = """<body name="flap" pos="2 0 1"><joint name="aside" axis="0 1 0"/><geom size=".05"/>
<body name="flaplet" pos="0 0 .2"><joint name="beside" axis="0 1 0"/><geom size=".05"/></body>
</body>"""
WINCH = '<tendon><fixed name="winch"><joint joint="shoulder" coef="1"/></fixed></tendon>'
ROPE = """<tendon><spatial name="rope"><site site="post"/><site site="tip"/></spatial></tendon>"""
PAIR = """<tendon><fixed name="pair"><joint joint="shoulder" coef="1"/>
<joint joint="elbow" coef="-1"/></fixed>
<fixed name="sum"><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="1"/></fixed>
</tendon>"""
ELBOW, TWO = 'joint1="elbow"', "couples aside, elbow,"
BOTH = "couples shoulder, elbow,"


def equality(text: str) -> str:
    return f"<equality>{text}</equality>"


TIED = {
    "gear": (equality('<joint joint1="elbow" joint2="shoulder" polycoef="0 -1 0 0 0"/>'), BOTH),
    "polynomial": (equality(f'<joint {ELBOW} joint2="shoulder" polycoef=".1 0 .5 0 0"/>'), BOTH),
    "locked": (equality('<joint name="lock" joint1="elbow"/>'), "'lock' couples elbow,"),
    "follows another": (equality(f'<joint {ELBOW} joint2="aside"/>'), "'elbow' and 'aside' " + TWO),
    "leads another": (
        equality('<joint joint1="aside" joint2="elbow"/><joint joint1="beside" joint2="aside"/>'),
        "'aside' and 'elbow' " + TWO,
    ),
    "tendons": (WINCH + equality('<tendon tendon1="cable" tendon2="winch"/>'), BOTH),
    "rope": (ROPE + equality('<tendon tendon1="rope"/>'), "<tendon> of 'rope' " + BOTH),
    "pinned": (equality('<connect body1="lower" body2="world" anchor="0 0 0"/>'), BOTH),
    "pinned at sites": (equality('<connect site1="tip" site2="post"/>'), BOTH),
    "welded": (equality('<weld name="loop" body1="lower" body2="flap"/>'), "'loop' couples aside"),
    "dragged": (equality('<weld body1="target" body2="lower"/>'), "'target' and 'lower' " + BOTH),
}


def write_coupled_arm(folder: Path, more: str, actuators: str = MOTORS) -> RobotConfig:
    """Write an arm with `more` sections in its model."""
    robot = pendulum(folder, actuators, POST + TARGET + FLAP, torque=(45.0, 10.0))
    text = robot.model.read_text()
    robot.model.write_text(text.replace("</mujoco>", f"{more}</mujoco>"))
    return robot


@pytest.mark.parametrize(("more", "names"), TIED.values(), ids=TIED)
def test_a_tied_joint_of_the_arm_is_refused_by_name(tmp_path: Path, more: str, names: str) -> None:
    with pytest.raises(RobotError) as refused:
        build_cell(write_coupled_arm(tmp_path, more), SceneConfig(), CLOCK_NS)
    text = str(refused.value)
    assert names in text
    assert "driven independently; remove it from the model" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    "more",
    [
        equality('<joint joint1="elbow" joint2="shoulder" active="false"/>'),
        equality('<joint joint1="aside" joint2="beside"/>'),
        equality('<connect body1="flaplet" body2="world" anchor="0 0 0"/>'),
        PAIR,
    ],
)
def test_an_equality_that_ties_no_joint_of_the_arm_is_permitted(tmp_path: Path, more: str) -> None:
    build_cell(write_coupled_arm(tmp_path, more), SceneConfig(), CLOCK_NS)


def test_joints_that_share_an_actuator_are_refused(tmp_path: Path) -> None:
    one, other = '<motor name="winch" tendon="pair"/>', '<motor tendon="sum"/>'
    with pytest.raises(RobotError, match="joints elbow, shoulder share one actuator"):
        build_cell(write_coupled_arm(tmp_path, PAIR, one), SceneConfig(), CLOCK_NS)
    build_cell(write_coupled_arm(tmp_path, PAIR, one + other), SceneConfig(), CLOCK_NS)
