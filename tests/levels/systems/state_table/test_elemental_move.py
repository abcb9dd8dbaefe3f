"""The elemental move level as a state table, after a restart of its board: where it goes on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from rack.backplane import semaphores
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.message import Message
from rack.backplane.segment import Segment, unlink
from rack.boards.classes import find_class
from rack.boards.config import load
from rack.boards.config.resolved import Resolved, resolve
from rack.boards.run.control_loop import VirtualControlLoop
from rack.levels.level import Executor
from rack.levels.systems.state_table.elemental_move import MoveTable

LEVEL = "elemental_move"
LAST = {"words": "pick block1", "in_state": "reaching", "sent": 7, "reached": 1, "put": -1}
"""Fields of its last status."""


@dataclass
class Bench:
    """The rack's memory, without any process, and the level on its board, as it starts."""

    segment: Segment
    plan: Resolved

    def write(self, port: str, **fields: object) -> None:
        """Write the level's last message of a port, as the board did before it died."""
        writer = open_writer(self.segment, f"{LEVEL}.{port}")
        for field, value in fields.items():
            setattr(writer.message, field, value)
        writer.write(0)
        writer.close()

    def restarted(self) -> tuple[MoveTable, Message]:
        """Return the level after it has recalled its last messages, and the command that it would
        send down."""
        wiring = next(wiring for wiring in self.plan.tasks if wiring.task == LEVEL)
        level = find_class(wiring.target, Executor)(wiring.context)
        task = VirtualControlLoop(self.segment, wiring, level)
        assert isinstance(level, MoveTable)
        task.inputs.read(50)
        level.recall(task.inputs.values, task.outputs.messages)
        return level, task.outputs.messages.command


@pytest.fixture
def bench(rack_name: str) -> Iterator[Bench]:
    plan = resolve(load("nist-state-table", [f"name={rack_name}", "clock.mode=lockstep"]))
    segment = Segment.create(plan.layout, "")
    semaphores.create(plan.layout)
    yield Bench(segment, plan)
    semaphores.unlink(plan.layout)
    unlink(segment.rack)
    segment.close()


def test_it_goes_on_with_the_command_that_it_sent_down_last(bench: Bench) -> None:
    joints = np.linspace(0.1, 0.6, 6)
    bench.write("status", **LAST)
    bench.write(
        "command",
        words="pose above",
        speed=0.5,
        object=1,
        joints=joints,
        aim=(1.0, 2.0, 3.0),
        yaw=0.25,
    )
    level, command = bench.restarted()
    assert (level.state, level.words) == ("reaching", ["pick", "block1"])
    assert (level._sent, level._reached, level._speed, level._row, level._yaw) == (
        7,
        True,
        0.5,
        1,
        0.25,
    )
    np.testing.assert_array_equal(level._joints, joints)
    np.testing.assert_array_equal(level._aim, (1.0, 2.0, 3.0))
    assert (command.words, command.object) == ("pose above", 1)


def test_without_a_command_of_its_own_it_starts_where_the_arm_is(bench: Bench) -> None:
    bench.write("status", **LAST)
    level, command = bench.restarted()
    home = level._cell.home
    # It knows its own state, and nothing of a command: no joints are taken from a mailbox that is
    # still empty.
    assert (level.state, level._sent, level._reached, level._speed) == ("reaching", 0, True, 1.0)
    np.testing.assert_array_equal(level._joints, home)
    assert (level._row, command.words) == (-1, "")


def test_a_board_that_starts_for_the_first_time_recalls_nothing(bench: Bench) -> None:
    level, command = bench.restarted()
    assert (level.state, level._sent, level.words, command.words) == ("idle", 0, [], "")
    np.testing.assert_array_equal(level._joints, level._cell.home)


def test_it_recalls_its_last_messages_in_its_first_cycle_only(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.write("status", **LAST)
    wiring = next(wiring for wiring in bench.plan.tasks if wiring.task == LEVEL)
    task = VirtualControlLoop(
        bench.segment, wiring, find_class(wiring.target, Executor)(wiring.context)
    )
    recalled: list[int] = []
    monkeypatch.setattr(task.executor, "recall", lambda read, write: recalled.append(1))
    for tick in (50, 62):
        task.inputs.read(tick)
        task.process(tick)
    assert recalled == [1]
