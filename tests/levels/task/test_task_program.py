"""The `[task]` table: valid programs, and one line for each mistake."""

from __future__ import annotations

from typing import Any

import pytest

from rack.boards.config import load, resolve
from rack.boards.errors import ConfigError
from rack.levels.errors import ProgramError
from rack.levels.task.program import Goto, Home, Transfer, read_program
from tests.levels.arms import config

PUMA, SCENE = config("puma560")
NASREM = load("nasrem")
PICK, GOTO, PLACE = {"do": "transfer"}, {"do": "goto"}, [0.5, 0.3, 0.5]
OBJECTS, FINITE, NAN = "objects: block1, block2, peg", "should be a finite number", float("nan")
BY = "simulated time by which the action must be done [s]"


def test_actions_of_every_kind_are_read() -> None:
    actions = [
        {**PICK, "object": "peg", "to": PLACE, "yaw": 1.0, "by": 30},
        {**GOTO, "position": [0.5, 0.2, 0.7], "direction": [0, 0, -1]},
        {**GOTO, "joints": [0, 0, 0, 0, 0, 0]},
        {"do": "home"},
    ]
    assert read_program({"action": actions}, PUMA, SCENE).action == (
        Transfer(object="peg", to=(0.5, 0.3, 0.5), yaw=1.0, by=30.0),
        Goto(position=(0.5, 0.2, 0.7), direction=(0.0, 0.0, -1.0)),
        Goto(joints=(0.0,) * 6),
        Home(),
    )
    assert read_program({}, PUMA, SCENE).action == ()


@pytest.mark.parametrize(
    ("action", "line"),
    [
        ({"do": "fly"}, '.do = "fly": valid values: transfer, goto, home'),
        ({"object": "peg"}, ".do: missing; it selects the kind of table"),
        ({**PICK, "object": "cup", "to": PLACE}, f'.object = "cup": not in the scene; {OBJECTS}'),
        ({**PICK, "object": "peg"}, ".to: missing; final position of the object's origin [m]"),
        ({"do": "home", "by": 0}, f".by = 0: should be greater than 0; {BY}"),
        ({"do": "home", "speed": 2}, ".speed = 2: unknown key; known: by, do"),
        ({"do": "goto"}, ": a goto has either position or joints"),
        (
            {**GOTO, "joints": [0, 0]},
            ".joints = [0.0, 0.0]: has 2 values but needs 6, one per joint",
        ),
        (
            {**GOTO, "position": PLACE, "direction": [0, 0, 0]},
            ": direction is zero; its length must not be zero",
        ),
        ({**GOTO, "position": [0, 0, NAN]}, f".position[2] = nan: {FINITE}; of the tool [m]"),
    ],
)
def test_each_mistake_is_one_line(action: dict[str, Any], line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        resolve(NASREM.model_copy(update={"task": {"action": [action]}}))
    assert str(caught.value) == f"task.action[0]{line}"


def test_a_transfer_needs_a_gripper() -> None:
    robot, scene = config("k1607")
    with pytest.raises(ProgramError, match="the robot has no gripper; valid actions: goto, home"):
        read_program({"action": [{**PICK, "object": "peg", "to": PLACE}]}, robot, scene)
