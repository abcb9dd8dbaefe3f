"""The `[[command]]` tables of a config: what an operator says, and when, before the rack it is for is looked at."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from rack.levels.operator import Goal, Operation
from rack.levels.tables import LAST_TICK, Finite, Table

Vector = tuple[Finite, Finite, Finite]
Said = Literal["hold", "resume", "setpoint", "goto"]


class CommandConfig(Table):
    """`[[command]]`: one command of an operator to one level."""

    level: str = Field(description="board whose level is commanded, as in servo or task")
    what: Said = Field(description="hold: come to rest; resume: go on; setpoint, goto: move to a goal, and stay there")
    tick: int | None = Field(
        None, ge=0, le=LAST_TICK, description="tick at which it is given; at most one of tick and at"
    )
    at: Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)] | None = Field(
        None, description="instead of tick: simulated time, s"
    )
    joints: tuple[Finite, ...] | None = Field(None, description="goal: joint positions, rad, one a joint")
    position: Vector | None = Field(None, description="goal: of the tool, m, with quaternion or direction")
    quaternion: tuple[Finite, Finite, Finite, Finite] | None = Field(None, description="of the tool, as w, x, y, z")
    direction: Vector | None = Field(None, description="of the tool's z axis, any turn about it; down when not given")
    home: bool = Field(False, description="goal: where the arm starts")

    @property
    def said(self) -> Operation:
        """What is to be done."""
        return Operation[self.what.upper()]

    @property
    def goals(self) -> list[Goal]:
        """The goals that are given: there must be one, or none."""
        found = [Goal.JOINTS] if self.joints is not None else []
        if self.position is not None or self.quaternion is not None or self.direction is not None:
            found.append(Goal.DIRECTION if self.quaternion is None else Goal.POSE)
        return [*found, Goal.HOME] if self.home else found
