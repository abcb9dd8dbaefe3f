"""The task level as a state table.

Its plan is a static list of steps, each with an object and the place for it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pydantic import Field as Key

from rack.backplane.message import integer_field
from rack.levels.level import OPERATOR, Input, LevelContext, Mismatches, Output
from rack.levels.operator import Operation
from rack.levels.systems.state_table.elemental_move import MoveTable, MoveTableStatus
from rack.levels.systems.state_table.level import (
    BELOW,
    OPERATIONS,
    StateTableExecutor,
    StateTableParams,
    TableCommand,
    TableStatus,
    build_vocabulary,
    classify_answer,
)
from rack.levels.systems.state_table.table import Name
from rack.levels.tables import SceneConfig, Table, read_params

COMMANDS_PER_STEP = 2
"""Commands to the level below in one step: one to pick, one to place."""


class TaskTableStatus(TableStatus, version=1):
    """Status of the task level of state tables."""

    action: int = integer_field("steps done", "u2")
    actions: int = integer_field("steps of the plan", "u2")
    moves_done: int = integer_field("commands done by the level below", "u2")
    moves: int = integer_field("commands of the plan", "u2")
    sent: int = integer_field("serial of the newest command sent down (0: none)")


class StepConfig(Table):
    """`[[plan.step]]`: an object and its destination."""

    object: str
    """name of an object of the scene"""
    place: Name
    """name of a place that the level below knows"""


class TaskPlanConfig(Table):
    """`[plan]` of the task level's table."""

    step: tuple[StepConfig, ...] = Key(min_length=1, max_length=100)
    """steps, in order"""


class TaskTable(StateTableExecutor):
    """Executor that sends the commands of its steps to the level below, one after the other."""

    above = None  # type: ignore[assignment]  # drops the port: no level is above
    below = Input(MoveTableStatus, "below.status")
    last_command = Input(TableCommand, "own.command")
    last_status = Input(TaskTableStatus, "own.status")
    operator = OPERATOR
    command = Output(TableCommand)
    status = Output(TaskTableStatus, rests_on=below)
    commands = OPERATIONS
    vocabulary = build_vocabulary(
        conditions={
            "below": BELOW,
            # Whether a step of the plan is left.
            "step": ("more", "none"),
        },
        actions={
            # Command the level below, with the object or place of the step.
            "send": (("pick", "place", "home"),),
            "next": (),
        },
        plan=TaskPlanConfig,
    )

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._steps_done = 0

    @classmethod
    def find_plan_flaws(cls, scene: SceneConfig, plan: Any) -> list[str]:
        """Return a line for each step whose object is unknown."""
        known = ", ".join(scene.objects) or "none"
        return [
            f"plan.step[{index}].object: unknown '{step.object}'; objects: {known}"
            for index, step in enumerate(plan.step)
            if step.object not in scene.objects
        ]

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield every mistake in every table, and steps whose place the level below lacks.

        The tables of the level below name the places.
        """
        own_mismatches = [*super().find_mismatches(context)]
        yield from own_mismatches
        tables = read_params(StateTableParams, context.params).tables
        for other, pace in context.below.items():
            params = pace.params
            if own_mismatches or [*MoveTable.find_mismatches(replace(context, params=params))]:
                continue
            commands = MoveTable.list_operation_names(Operation.DO, params, context.scene)
            for name, path in tables.items():
                for index, step in enumerate(cls.read(path, context.scene).plan.step):
                    if f"place {step.place}" not in commands:
                        why = (
                            f"plan.step[{index}].place: unknown '{step.place}'; '{other}'"
                            f" knows: {', '.join(commands)}"
                        )
                        yield f"params.tables.{name}", path.name, why

    def restore_state(self) -> None:
        """Continue with the current step after a restart."""
        super().restore_state()
        if self.last_status.has_message and self.last_command.has_message:
            self._steps_done = self.last_status.message.action
            self.command.copy_from(self.last_command.message)
            self.command.id = self.last_status.message.sent

    def evaluate_conditions(self, tick: int) -> dict[str, str]:
        """Return the values of the conditions `below` and `step`."""
        self.detail = self.below.message.reason
        self.resting = self.below.message.resting
        is_left = self._steps_done < len(self.table.plan.step)
        return {
            "below": classify_answer(self.below, self.command.id),
            "step": ("none", "more")[is_left],
        }

    def do_send(self, verb: str) -> None:
        """Command the level below to pick, place or go home."""
        steps = self.table.plan.step
        step = steps[min(self._steps_done, len(steps) - 1)]
        words = {"pick": f"pick {step.object}", "place": f"place {step.place}", "home": "home"}
        self.command.id += 1
        self.command.words = words[verb]

    def do_next(self) -> None:
        """Advance to the next step."""
        self._steps_done += 1

    def write_outputs(self, tick: int) -> None:
        """Write the command for the level below and the number of completed steps."""
        self.command.hold = self.is_held
        status = self.status
        steps = len(self.table.plan.step)
        status.action = min(self._steps_done, steps)
        status.actions = steps
        status.sent = self.command.id
        status.moves = steps * COMMANDS_PER_STEP
        status.moves_done = status.action * COMMANDS_PER_STEP
