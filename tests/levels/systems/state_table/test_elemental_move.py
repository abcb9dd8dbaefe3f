"""The elemental move level as a state table: restarts, conditions and unreachable poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.message import Message
from rack.backplane.segment import Segment, unlink_segment
from rack.boards.config import load
from rack.boards.config.resolved import Resolved, resolve
from rack.boards.run.control_loop import VirtualControlLoop
from rack.levels.level import Executor
from rack.levels.messages import WorldState
from rack.levels.references import find_class
from rack.levels.systems.state_table.elemental_move import MAX_REST_SPEED_M_S, MoveTable
from rack.levels.systems.state_table.level import WordCommand
from rack.levels.systems.state_table.primitive import JointMoveStatus

LEVEL = "elemental_move"
LAST = {"words": "pick block1", "in_state": "reaching", "sent": 7, "reached": 1, "put": -1}
"""Fields of its last status."""


@dataclass
class Bench:
    """Segment of the rack without any process, and the plan from which its level starts."""

    segment: Segment
    plan: Resolved

    def write(self, port: str, **fields: object) -> None:
        """Write the level's last message of a port, as the board did before it died."""
        writer = open_writer(self.segment, f"{LEVEL}.{port}")
        for field, value in fields.items():
            setattr(writer.message, field, value)
        writer.write(0)
        writer.close()

    def restart(self) -> tuple[MoveTable, Message]:
        """Return the level with its restored state, and the command that it would send down."""
        wiring = next(wiring for wiring in self.plan.tasks if wiring.task == LEVEL)
        level = find_class(wiring.target, Executor)(wiring.context)
        task = VirtualControlLoop(self.segment, wiring, level, None)
        assert isinstance(level, MoveTable)
        task.inputs.read(50)
        level.restore_state()
        level.write_outputs(50)
        return level, level.command


@pytest.fixture
def bench(rack_name: str) -> Iterator[Bench]:
    plan = resolve(load("nist-state-table", [f"name={rack_name}", "clock.mode=lockstep"]))
    segment = Segment.create(plan.layout, "")
    yield Bench(segment, plan)
    unlink_segment(segment.rack)
    segment.close()


def test_a_restarted_level_continues_with_its_last_command(bench: Bench) -> None:
    joints = np.linspace(0.1, 0.6, 6)
    bench.write("status", **LAST)
    pose = {"joints": joints, "aim": (1.0, 2.0, 3.0), "yaw": 0.25}
    bench.write("command", words="pose above", speed=0.5, object=1, **pose)
    level, command = bench.restart()
    assert (level.state, level.words) == ("reaching", ["pick", "block1"])
    assert level._reached
    assert (command.id, command.words, command.object) == (7, "pose above", 1)
    assert (command.speed, command.yaw) == (0.5, 0.25)
    np.testing.assert_array_equal(command.joints, joints)
    np.testing.assert_array_equal(command.aim, (1.0, 2.0, 3.0))


def test_a_restarted_level_without_a_last_command_starts_at_home(bench: Bench) -> None:
    bench.write("status", **LAST)
    level, command = bench.restart()
    home = level._cell.home
    # It knows its state but no command. No joints are taken from a mailbox that is still empty.
    assert (level.state, level._reached) == ("reaching", True)
    assert (command.id, command.words, command.speed, command.object) == (0, "", 1.0, -1)
    np.testing.assert_array_equal(command.joints, home)


def test_a_board_that_starts_for_the_first_time_restores_nothing(bench: Bench) -> None:
    level, command = bench.restart()
    assert (level.state, level.words, command.id, command.words) == ("idle", [], 0, "")


class Arm:
    """The level, whose inputs from the arm and the world are set by the test."""

    def __init__(self, bench: Bench) -> None:
        self.level, _ = bench.restart()
        self.world = WorldState(self.level.world.message.record.dtype)
        self.below = JointMoveStatus(self.level.below.message.record.dtype)
        self.world.revision = 1
        self.place = np.array([0.4, -0.2, 0.1])
        self.world.position[0] = self.place
        self.world.quaternion[:] = (1.0, 0.0, 0.0, 0.0)

    def look(self, *, lost: bool = False) -> dict[str, str]:
        vars(self.level).update(
            world=Reading(self.world, Verdict.NEW, lost), below=Reading(self.below, Verdict.NEW)
        )
        return self.level.evaluate_conditions(50)


@pytest.fixture
def arm(bench: Bench) -> Arm:
    return Arm(bench)


def test_the_world_is_seen_once_it_has_been_sensed(arm: Arm) -> None:
    assert arm.look()["world"] == "seen"
    assert arm.look(lost=True)["world"] == "unseen"
    arm.world.revision = 0
    assert arm.look()["world"] == "unseen"
    assert arm.look()["target"] == "moving"


def test_a_target_is_there_while_it_rests_where_it_was(arm: Arm) -> None:
    assert arm.look()["target"] == "there"
    arm.level.command.object = 0
    arm.level.command.aim = arm.place
    moved = arm.level.table.plan.moved
    cases = [
        (0.0, 0.0, "there"),
        (0.99 * moved, 0.99 * MAX_REST_SPEED_M_S, "there"),
        (1.01 * moved, 0.0, "displaced"),
        (0.0, 1.01 * MAX_REST_SPEED_M_S, "moving"),
    ]
    for offset, speed, seen in cases:
        arm.world.position[0] = arm.place + np.array([0.0, offset, 0.0])
        arm.world.velocity[0] = (speed, 0.0, 0.0)
        assert arm.look()["target"] == seen


@pytest.mark.parametrize("words", ["", "home"])
def test_a_pose_without_an_object_is_not_reached(arm: Arm, words: str) -> None:
    arm.level._taken = WordCommand(False, 3, words)
    sent = arm.level.command.id
    pose = next(iter(arm.level.table.plan.pose))
    arm.level.do_move(pose)
    assert not arm.level._reached
    assert arm.level.command.id == sent
    # A pose out of reach is not reached either.
    arm.world.position[0] = (9.0, 0.0, 0.0)
    arm.look()
    arm.level._taken = WordCommand(False, 1, f"pick {arm.level.context.scene.objects[0]}")
    arm.level.do_move(pose)
    assert (arm.level.command.id, arm.look()["reach"]) == (sent, "no")
