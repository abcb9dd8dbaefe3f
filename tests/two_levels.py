"""Two small levels that count, for tests of configs: no arm, no cell."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pydantic

from rack.backplane.message import Command, Message, State, Status, field
from rack.levels.level import Executor, Input, Output, Planner, Program
from rack.levels.tables import RobotConfig, SceneConfig


class Bare(Message, version=1):
    """A status without a state."""

    fired: bool = field(doc="1: it has")


class Terse(Message, version=1):
    """A status without a reason."""

    state: State = field(doc="of the level")


class CountCommand(Command, version=1):
    goal: int = field(unit="1", doc="count to reach")


class CountStatus(Status, version=1):
    count: int = field(unit="1", doc="count reached")


class CountPlan(Message, version=1):
    steps: np.ndarray = field("i8", unit="1", doc="counts to go, by joint", shape="joints")


class SmallPlan(Message, version=1):
    steps: int = field(unit="1", doc="counts to go")


class Upper(Executor):
    """Commands a goal, reads how far it is."""

    below = Input(CountStatus, "below.status")
    command = Output(CountCommand)
    status = Output(CountStatus, rests_on=below)

    def process(self, tick: int) -> None:
        """Ask for one more."""
        self.command.goal = self.below.message.count + 1


class Stateless(Upper):
    """Has a status of its own, without a state or a reason."""

    status = Output(Bare, rests_on=Upper.below)


class Reasonless(Upper):
    """Holds, and has no field for the reason."""

    status = Output(Terse, rests_on=Upper.below)

    def process(self, tick: int) -> None:
        """Hold."""
        self.status.state = State.HOLDING


class CountProgram(Program):
    """A program: how far to count."""

    count: tuple[int, ...] = pydantic.Field((), description="counts to reach, one after the other")

    def find_mismatches(
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

    status = Output(CountStatus)


class Lower(Executor):
    """Counts towards the goal, by its own plan."""

    above = Input(CountCommand, "above.command")
    plan = Input(SmallPlan, "own.plan")
    status = Output(CountStatus)

    def process(self, tick: int) -> None:
        """Count to the goal."""
        self.status.count = self.above.message.goal


class Crashing(Lower):
    """Fails in its first cycle."""

    def process(self, tick: int) -> None:
        """Fail."""
        raise RuntimeError("no cycle at all")


class LowerPlanner(Planner):
    """Plans the way to the goal."""

    above = Input(CountCommand, "above.command")
    output = Output(SmallPlan)

    def plan(self, tick: int) -> None:
        """Plan one step."""
        self.output.steps = 1


class SizedPlanner(LowerPlanner):
    """Writes a plan whose size only a rack with an arm knows."""

    output = Output(CountPlan)


class PlanWriter(Executor):
    """Writes the mailbox of its own planner."""

    above = Input(CountCommand, "above.command")
    status = Output(CountStatus)
    plan = Output(SmallPlan)

    def process(self, tick: int) -> None:
        """Do nothing."""
