"""An operator's command in a config as the message that it becomes."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.mailbox.slots import build_message_dtype
from rack.backplane.message import Message
from rack.boards.config import RackConfig, load, resolve_layout
from rack.boards.config.commands import DOWN, build_request, describe_commands, parse_command
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
