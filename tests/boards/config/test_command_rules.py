"""Mistakes of an operator's commands: each one line, its place, its value and what is valid."""

from __future__ import annotations

from typing import Any

import pytest

from rack.backplane.address_map import OPERATOR_ENTRIES
from rack.boards.config import RackConfig, load
from rack.boards.config.cell import build_rack_cell
from rack.boards.config.commands import find_command_mistakes, parse_command
from rack.boards.config.published import gather_facts

HOME = [0.0, 0.7, -2.4, 0.0, -1.4, 0.0]
PLACE = {"position": [0.4, 0.1, 0.3]}


@pytest.fixture(scope="module")
def nasrem() -> RackConfig:
    return load("nasrem")


@pytest.fixture(scope="module")
def gentle() -> RackConfig:
    """A rack whose servo level has a control modification."""
    return load("configs/examples/own-modification/gentle.toml")


def mistakes(config: RackConfig, broken: frozenset[str] = frozenset(), **given: Any) -> list[str]:
    levels = gather_facts(config).levels
    return [
        str(found)
        for found in find_command_mistakes([("", parse_command(given))], config, levels, broken)
    ]


@pytest.mark.parametrize(
    "given",
    [
        {"level": "task", "what": "hold"},
        {"level": "task", "what": "goto", "home": True},
        {"level": "task", "what": "goto", **PLACE, "at": 2.0},
        {"level": "servo", "what": "setpoint", "joints": HOME},
    ],
)
def test_a_valid_command_has_no_mistakes(nasrem: RackConfig, given: dict[str, Any]) -> None:
    assert mistakes(nasrem, **given) == []


GOALS = "of 'task' takes one of: joints|pose|direction|home"
MISTAKES: list[tuple[dict[str, Any], str]] = [
    (
        {"level": "nobody", "what": "hold"},
        'level = "nobody": no level of this name takes commands; levels that do: servo, primitive,'
        " elemental_move, task",
    ),
    (
        {"level": "primitive", "what": "goto", "home": True},
        "what = \"goto\": 'primitive' does not take goto; it takes: hold, resume",
    ),
    ({"level": "task", "what": "hold", "home": True}, "home: hold takes no goal; remove it"),
    ({"level": "task", "what": "goto"}, f"goal: missing; goto {GOALS}"),
    (
        {"level": "task", "what": "goto", "home": True, **PLACE},
        f"goal: several given: direction|home; goto {GOALS}",
    ),
    (
        {"level": "servo", "what": "setpoint", **PLACE},
        "position: not a goal for setpoint of 'servo'; valid goals: joints",
    ),
    (
        {"level": "task", "what": "goto", "quaternion": [1.0, 0.0, 0.0, 0.0]},
        "position: missing; tool position, m",
    ),
    (
        {
            "level": "task",
            "what": "goto",
            **PLACE,
            "direction": [0.0, 0.0, 1.0],
            "quaternion": [1.0, 0.0, 0.0, 0.0],
        },
        "direction = [0.0, 0.0, 1.0]: quaternion is also given; give only one of quaternion,"
        " direction",
    ),
    (
        {"level": "task", "what": "goto", **PLACE, "direction": [0.0, 0.0, 0.0]},
        "direction = [0.0, 0.0, 0.0]: all zero; its length must not be zero",
    ),
    (
        {"level": "task", "what": "goto", **PLACE, "quaternion": [0.0, 0.0, 0.0, 0.0]},
        "quaternion = [0.0, 0.0, 0.0, 0.0]: all zero; its length must not be zero",
    ),
    (
        {"level": "servo", "what": "setpoint", "joints": HOME[:5]},
        f"joints = {HOME[:5]}: 5 values; must be 6, one per joint: j1, j2, j3, j4, j5, j6",
    ),
    (
        {"level": "servo", "what": "setpoint", "joints": [9.0, *HOME[1:]]},
        "joints = 9.0: out of range; joint 'j1' must be -2.78753 to 2.78753 rad",
    ),
    (
        {"level": "task", "what": "hold", "tick": 4, "at": 1.0},
        "at = 1.0: tick is also given; give only one of tick, at",
    ),
    (
        {"level": "task", "what": "hold", "name": "x"},
        'name = "x": hold takes no name; remove it',
    ),
    (
        {"level": "servo", "what": "modify", "name": "x", "on": True},
        "name = \"x\": modify of 'servo' knows: none",
    ),
]


@pytest.mark.parametrize(("given", "line"), MISTAKES)
def test_a_mistake_is_one_line(nasrem: RackConfig, given: dict[str, Any], line: str) -> None:
    assert mistakes(nasrem, **given) == [line]


def test_the_limits_of_a_joints_range_are_valid(nasrem: RackConfig) -> None:
    robot = nasrem.robot
    assert robot is not None
    ends = build_rack_cell(nasrem).limits.position.T.tolist()
    for joints in ends:
        assert mistakes(nasrem, level="servo", what="setpoint", joints=joints) == []


def test_more_commands_than_the_table_has_entries_are_refused(nasrem: RackConfig) -> None:
    hold = ("", parse_command({"level": "task", "what": "hold"}))
    levels = gather_facts(nasrem).levels
    assert find_command_mistakes([hold] * OPERATOR_ENTRIES, nasrem, levels) == []
    (found,) = find_command_mistakes([hold] * (OPERATOR_ENTRIES + 1), nasrem, levels)
    many = OPERATOR_ENTRIES + 1
    assert str(found) == (
        f"command = {many}: too many commands; at most {OPERATOR_ENTRIES} may be pending"
    )


def test_a_modification_is_added_or_removed_by_name(gentle: RackConfig) -> None:
    def of(**given: Any) -> list[str]:
        return mistakes(gentle, level="servo", what="modify", **given)

    assert of(name="gentle", on=True) == of(name="gentle", on=False) == []
    (unknown,) = of(name="rough", on=True)
    assert "rough" in unknown
    assert "gentle" in unknown
    (unsaid,) = of(name="gentle")
    assert "on" in unsaid
    (unnamed,) = of(on=True)
    assert "name" in unnamed


def test_commands_to_a_broken_board_are_not_checked(nasrem: RackConfig) -> None:
    broken = frozenset({"task"})
    assert mistakes(nasrem, broken, level="task", what="goto") == []
    assert len(mistakes(nasrem, broken, level="servo", what="goto")) == 1
