"""The `[task]` table: valid programs, and one line for each mistake."""

from __future__ import annotations

from typing import Any

import pytest

from rack.boards.config import load, resolve
from rack.boards.errors import ConfigError
from rack.levels.errors import ProgramError
from rack.levels.task.program import Goto, Home, TaskConfig, Transfer, read_program
from tests.levels.arms import config

PUMA, SCENE = config("puma560")
NASREM = load("nasrem")


def read_actions(*actions: dict[str, Any]) -> TaskConfig:
    return read_program({"action": list(actions)}, PUMA, SCENE)


def find_mistakes(*actions: dict[str, Any]) -> str:
    """Return all mistakes of a program, as the check of a config reports them."""
    with pytest.raises(ConfigError) as caught:
        resolve(NASREM.model_copy(update={"task": {"action": list(actions)}}))
    return str(caught.value)


def test_actions_of_every_kind_are_read() -> None:
    transfer, pose, joints, home = read_actions(
        {"do": "transfer", "object": "peg", "to": [0.5, 0.3, 0.5], "yaw": 1.0, "by": 30},
        {"do": "goto", "position": [0.5, 0.2, 0.7], "direction": [0, 0, -1]},
        {"do": "goto", "joints": [0, 0, 0, 0, 0, 0]},
        {"do": "home"},
    ).action
    assert isinstance(transfer, Transfer)
    assert transfer.by == 30.0
    assert isinstance(pose, Goto)
    assert pose.position == (0.5, 0.2, 0.7)
    assert isinstance(joints, Goto)
    assert joints.joints == (0.0,) * 6
    assert isinstance(home, Home)
    assert read_program({}, PUMA, SCENE).action == ()


@pytest.mark.parametrize(
    ("action", "line"),
    [
        ({"do": "fly"}, 'task.action[0].do = "fly": valid values: transfer, goto, home'),
        ({"object": "peg"}, "task.action[0].do: missing; it selects the kind of table"),
        (
            {"do": "transfer", "object": "cup", "to": [0.5, 0.3, 0.5]},
            'task.action[0].object = "cup": not in the scene; objects: block1, block2, peg',
        ),
        (
            {"do": "transfer", "object": "peg"},
            "task.action[0].to: missing; final position of the object's origin [m]",
        ),
        (
            {"do": "home", "by": 0},
            (
                "task.action[0].by = 0: should be greater than 0; simulated time by which the"
                " action must be done [s]"
            ),
        ),
        ({"do": "home", "speed": 2}, "task.action[0].speed = 2: unknown key; known: by, do"),
        ({"do": "goto"}, "task.action[0]: a goto has either position or joints"),
        (
            {"do": "goto", "joints": [0, 0]},
            "task.action[0].joints = [0.0, 0.0]: has 2 values but needs 6, one per joint",
        ),
        (
            {"do": "goto", "position": [0, 0, 1], "direction": [0, 0, 0]},
            "task.action[0]: direction is zero; its length must not be zero",
        ),
        (
            {"do": "goto", "position": [0, 0, float("nan")]},
            "task.action[0].position[2] = nan: should be a finite number; of the tool [m]",
        ),
    ],
)
def test_each_mistake_is_one_line_with_place_value_and_what_is_valid(
    action: dict[str, Any], line: str
) -> None:
    assert find_mistakes(action) == line


def test_a_transfer_needs_a_gripper() -> None:
    robot, scene = config("k1607")
    with pytest.raises(ProgramError, match="the robot has no gripper; valid actions: goto, home"):
        read_program(
            {"action": [{"do": "transfer", "object": "peg", "to": [0, 0, 0]}]}, robot, scene
        )
