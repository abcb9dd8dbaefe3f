"""Two small levels that count, for tests of configs: no arm, no cell."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pydantic

from rack.backplane.message import Field, Message, MessageType, State, command, status
from rack.levels.level import Executor, Input, Planner, Ports, Program
from rack.levels.tables import RobotConfig, SceneConfig

COUNT_COMMAND = command("count_command", 1, Field("goal", "i8", "1", "count to reach"))
COUNT_STATUS = status("count_status", 1, Field("count", "i8", "1", "count reached"))
COUNT_PLAN = MessageType(
    "count_plan", 1, (Field("steps", "i8", "1", "counts to go, by joint", ("joints",)),)
)
SMALL_PLAN = MessageType("small_plan", 1, (Field("steps", "i8", "1", "counts to go"),))


class Upper(Executor):
    """Commands a goal, reads how far it is."""

    inputs = {"status": Input(COUNT_STATUS, "below.status")}
    outputs = {"command": COUNT_COMMAND, "status": COUNT_STATUS}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Ask for one more."""
        write.command.goal = read.status.value.count + 1


class Stateless(Upper):
    """Has a status of its own, without a state or a reason."""

    outputs = {
        "command": COUNT_COMMAND,
        "status": MessageType("bare", 1, (Field("fired", "u1", "1", "1: it has"),)),
    }


class Reasonless(Upper):
    """Holds, and has no field for the reason."""

    outputs = {
        "command": COUNT_COMMAND,
        "status": MessageType("terse", 1, (Field("state", "u1", State, "of the level"),)),
    }

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Hold."""
        write.status.state = State.HOLDING


class CountProgram(Program):
    """A program: how far to count."""

    count: tuple[int, ...] = pydantic.Field((), description="counts to reach, one after the other")

    def misfits(
        self, robot: RobotConfig | None, scene: SceneConfig
    ) -> Iterator[tuple[str, Any, str]]:
        """Refuse negative counts, for a reason that depends on the scene."""
        for at, count in enumerate(self.count):
            if count < 0:
                yield (
                    f"count[{at}]",
                    count,
                    f"nothing to count; objects: {', '.join(scene.objects) or 'none'}",
                )


class Programmed(Upper):
    """Reads a program of its own from `[task]`."""

    program = CountProgram


class Unfinished(Executor):
    """A level whose author has not written its method."""

    outputs = {"status": COUNT_STATUS}


class Lower(Executor):
    """Counts towards the goal, by its own plan."""

    inputs = {
        "command": Input(COUNT_COMMAND, "above.command"),
        "plan": Input(SMALL_PLAN, "own.plan"),
    }
    outputs = {"status": COUNT_STATUS}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Count to the goal."""
        write.status.count = read.command.value.goal


class Crashing(Lower):
    """Fails in its first cycle."""

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Fail."""
        raise RuntimeError("no cycle at all")


class LowerPlanner(Planner):
    """Plans the way to the goal."""

    inputs = {"command": Input(COUNT_COMMAND, "above.command")}
    output = SMALL_PLAN

    def plan(self, read: Ports, write: Message, tick: int) -> None:
        """Plan one step."""
        write.steps = 1


class SizedPlanner(LowerPlanner):
    """Writes a plan whose size only a rack with an arm knows."""

    output = COUNT_PLAN


class PlanWriter(Lower):
    """Writes the mailbox of its own planner."""

    outputs = {"status": COUNT_STATUS, "plan": SMALL_PLAN}
