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
TURNED, ALONG = {"quaternion": [1.0, 0.0, 0.0, 0.0]}, {"direction": [0.0, 0.0, 1.0]}


@pytest.fixture(scope="module")
def nasrem() -> RackConfig:
    return load("nasrem")


def mistakes(
    config: RackConfig, level: str, what: str, broken: frozenset[str] = frozenset(), **given: Any
) -> list[str]:
    command = parse_command({"level": level, "what": what, **given})
    levels = gather_facts(config).levels
    return [*map(str, find_command_mistakes([("", command)], config, levels, broken))]


@pytest.mark.parametrize(
    ("level", "what", "more"),
    [
        ("task", "hold", {}),
        ("task", "goto", {"home": True}),
        ("task", "goto", {**PLACE, "at": 2.0}),
        ("servo", "setpoint", {"joints": HOME}),
    ],
)
def test_a_valid_command_has_no_mistakes(
    nasrem: RackConfig, level: str, what: str, more: dict[str, Any]
) -> None:
    assert mistakes(nasrem, level, what, **more) == []


Command = tuple[str, str, dict[str, Any]]
ONE_OF = "goto of 'task' takes one of: joints|pose|direction|home"
NO_LENGTH = "all zero; its length must not be zero"
MISTAKES: list[tuple[Command, str]] = [
    (
        ("nobody", "hold", {}),
        'level = "nobody": no level of this name takes commands; levels that do: servo, primitive,'
        " elemental_move, task",
    ),
    (
        ("primitive", "goto", {"home": True}),
        "what = \"goto\": 'primitive' does not take goto; it takes: hold, resume",
    ),
    (("task", "hold", {"home": True}), "home: hold takes no goal; remove it"),
    (("task", "goto", {}), f"goal: missing; {ONE_OF}"),
    (
        ("task", "goto", {"home": True, **PLACE}),
        f"goal: several given: direction|home; {ONE_OF}",
    ),
    (
        ("servo", "setpoint", PLACE),
        "position: not a goal for setpoint of 'servo'; valid goals: joints",
    ),
    (("task", "goto", TURNED), "position: missing; tool position, m"),
    (
        ("task", "goto", {**PLACE, **ALONG, **TURNED}),
        "direction = [0.0, 0.0, 1.0]: quaternion is also given; give only one of quaternion,"
        " direction",
    ),
    (("task", "goto", {**PLACE, "direction": [0.0] * 3}), f"direction = {[0.0] * 3}: {NO_LENGTH}"),
    (
        ("task", "goto", {**PLACE, "quaternion": [0.0] * 4}),
        f"quaternion = {[0.0] * 4}: {NO_LENGTH}",
    ),
    (
        ("servo", "setpoint", {"joints": HOME[:5]}),
        f"joints = {HOME[:5]}: 5 values; must be 6, one per joint: j1, j2, j3, j4, j5, j6",
    ),
    (
        ("servo", "setpoint", {"joints": [9.0, *HOME[1:]]}),
        "joints = 9.0: out of range; joint 'j1' must be -2.78753 to 2.78753 rad",
    ),
    (
        ("task", "hold", {"tick": 4, "at": 1.0}),
        "at = 1.0: tick is also given; give only one of tick, at",
    ),
    (("task", "hold", {"name": "x"}), 'name = "x": hold takes no name; remove it'),
    (("servo", "modify", {"name": "x", "on": True}), "name = \"x\": modify of 'servo' knows: none"),
]


@pytest.mark.parametrize(("command", "line"), MISTAKES)
def test_a_mistake_is_one_line(nasrem: RackConfig, command: Command, line: str) -> None:
    level, what, more = command
    assert mistakes(nasrem, level, what, **more) == [line]


def test_the_limits_of_a_joints_range_are_valid(nasrem: RackConfig) -> None:
    for joints in build_rack_cell(nasrem).limits.position.T.tolist():
        assert mistakes(nasrem, "servo", "setpoint", joints=joints) == []


def test_more_commands_than_the_table_has_entries_are_refused(nasrem: RackConfig) -> None:
    hold = ("", parse_command({"level": "task", "what": "hold"}))
    levels = gather_facts(nasrem).levels
    assert find_command_mistakes([hold] * OPERATOR_ENTRIES, nasrem, levels) == []
    (found,) = find_command_mistakes([hold] * (OPERATOR_ENTRIES + 1), nasrem, levels)
    many = OPERATOR_ENTRIES + 1
    assert str(found) == (
        f"command = {many}: too many commands; at most {OPERATOR_ENTRIES} may be pending"
    )


def test_a_modification_is_added_or_removed_by_name() -> None:
    gentle = load("configs/examples/own-modification/gentle.toml")

    def modify(**given: Any) -> list[str]:
        return mistakes(gentle, "servo", "modify", **given)

    assert modify(name="gentle", on=True) == modify(name="gentle", on=False) == []
    for given, words in (
        ({"name": "rough", "on": True}, ("rough", "gentle")),
        ({"name": "gentle"}, ("on",)),
        ({"on": True}, ("name",)),
    ):
        (mistake,) = modify(**given)
        assert all(word in mistake for word in words)


def test_commands_to_a_broken_board_are_not_checked(nasrem: RackConfig) -> None:
    broken = frozenset({"task"})
    assert mistakes(nasrem, "task", "goto", broken) == []
    assert len(mistakes(nasrem, "servo", "goto", broken)) == 1
