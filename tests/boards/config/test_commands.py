"""An operator's command in a config: the message that it becomes, and its mistakes, each one line,
its place, its value and what is valid."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.address_map import OPERATOR_ENTRIES
from rack.backplane.mailbox.slots import build_message_dtype
from rack.backplane.message import Message
from rack.boards.config import RackConfig, load, resolve_layout
from rack.boards.config.cell import build_rack_cell
from rack.boards.config.commands import (
    DOWN,
    build_request,
    describe_commands,
    find_command_mistakes,
    parse_command,
)
from rack.boards.config.published import gather_facts
from rack.levels.operator import Goal, Operation

HOME = [0.1 * k for k in range(6)]
GOTO = {"level": "task", "what": "goto", "position": [0.4, 0.1, 0.3]}


@pytest.fixture(scope="module")
def nasrem() -> RackConfig:
    return load("nasrem")


def message_of(config: RackConfig, **given: object) -> tuple[Message, int]:
    """Return the message of a command, and the tick at which it is given."""
    layout = resolve_layout(config)
    made = build_request(parse_command(given), config, gather_facts(config).levels, layout)
    box = layout.mailboxes[made.mailbox]
    assert box.name == f"{given['level']}.operator"
    message = Message(build_message_dtype(box.fields, box.size))
    message.raw[:] = np.frombuffer(made.message, np.uint8)
    return message, made.tick


def test_a_joint_goal_has_a_position_for_every_joint(nasrem: RackConfig) -> None:
    message, tick = message_of(nasrem, level="servo", what="setpoint", joints=HOME, tick=40)
    assert (message.what, message.goal) == (Operation.SETPOINT, Goal.JOINTS)
    assert (message.count, tick) == (6, 40)
    assert message.joints[:6].tolist() == pytest.approx(HOME)
    assert not message.joints[6:].any()
    assert not message.position.any()


def test_a_position_goal_points_down_by_default(nasrem: RackConfig) -> None:
    message, tick = message_of(nasrem, **GOTO, at=1.0)
    assert (message.goal, message.count, tick) == (Goal.DIRECTION, 0, 400)
    assert message.position.tolist() == [0.4, 0.1, 0.3]
    assert tuple(message.direction) == DOWN
    message, _ = message_of(nasrem, **GOTO, direction=[1.0, 0.0, 0.0])
    assert message.direction.tolist() == [1.0, 0.0, 0.0]


def test_a_quaternion_is_normalised(nasrem: RackConfig) -> None:
    message, _ = message_of(nasrem, **GOTO, quaternion=[0.0, 3.0, 0.0, 4.0])
    assert message.goal == Goal.POSE
    assert message.quaternion.tolist() == pytest.approx([0.0, 0.6, 0.0, 0.8])


def test_the_commands_of_a_level_are_listed_with_their_valid_names(nasrem: RackConfig) -> None:
    assert describe_commands(gather_facts(nasrem).levels["primitive"]) == "hold, resume"
    config = load("configs/examples/own-modification/gentle.toml")
    servo = gather_facts(config).levels["servo"]
    assert "modify gentle on|off" in describe_commands(servo)
    assert "set bandwidth|damping" in describe_commands(servo)
    assert servo.names == ("gentle",)


AT_HOME = [0.0, 0.7, -2.4, 0.0, -1.4, 0.0]
PLACE = {"position": [0.4, 0.1, 0.3]}
TURNED, ALONG = {"quaternion": [1.0, 0.0, 0.0, 0.0]}, {"direction": [0.0, 0.0, 1.0]}


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
        ("servo", "setpoint", {"joints": AT_HOME}),
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
        ("servo", "setpoint", {"joints": AT_HOME[:5]}),
        f"joints = {AT_HOME[:5]}: 5 values; must be 6, one per joint: j1, j2, j3, j4, j5, j6",
    ),
    (
        ("servo", "setpoint", {"joints": [9.0, *AT_HOME[1:]]}),
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
