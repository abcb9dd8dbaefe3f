"""The program of a coordinator, `[task]`: steps, each with what one or more arms do in it at the
same time."""

from __future__ import annotations

import zlib
from typing import Annotated

from pydantic import Field, StringConstraints

from rack.levels.level import Misfits, Program
from rack.levels.operator import MAX_JOINTS
from rack.levels.systems.cell.messages import OBJECT_BYTES
from rack.levels.tables import RobotConfig, SceneConfig, Table
from rack.levels.task.program import Goto, Home, Transfer

MAX_STEPS = 1000
ArmName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,22}$")]
ARM = Field(description="arm that does it")


class ArmTransfer(Transfer):
    """A transfer, by an arm."""

    arm: ArmName = ARM


class ArmGoto(Goto):
    """A goto, by an arm."""

    arm: ArmName = ARM


class ArmHome(Home):
    """The way home, of an arm."""

    arm: ArmName = ARM


ArmAction = Annotated[ArmTransfer | ArmGoto | ArmHome, Field(discriminator="do")]


class CellStep(Table):
    """`[[task.step]]`: actions that begin together, once every arm has answered that it can do its
    own by its time."""

    do: tuple[ArmAction, ...]
    """actions, one for each arm that has a part in the step"""

    @property
    def actions(self) -> dict[str, ArmTransfer | ArmGoto | ArmHome]:
        """The actions by arm."""
        return {action.arm: action for action in self.do}


class CellProgram(Program):
    """A program for several arms: steps, each begun when the one before it is done."""

    step: tuple[CellStep, ...] = Field((), max_length=MAX_STEPS)
    """steps, done in their order"""

    @property
    def checksum(self) -> int:
        """A number that two different programs hardly share, above 0."""
        return zlib.crc32(self.model_dump_json().encode()) or 1

    def misfits(self, robot: RobotConfig | None, scene: SceneConfig) -> Misfits:
        """Yield key, value and reason of steps without actions or with two for an arm, times that
        do not rise, and what is too long for an order.
        """
        latest = 0.0
        for k, step in enumerate(self.step):
            arms: set[str] = set()
            if not step.do:
                yield f"step[{k}].do", [], "has no action; permitted: one or more"
            for n, action in enumerate(step.do):
                place = f"step[{k}].do[{n}]"
                if action.arm in arms:
                    yield (
                        f"{place}.arm",
                        action.arm,
                        "has another action in this step; permitted: one action per arm",
                    )
                if action.by is not None and action.by <= latest:
                    yield (
                        f"{place}.by",
                        action.by,
                        f"an earlier step has {latest:g}; permitted: later than that",
                    )
                # An order holds names and joints of limited length.
                if isinstance(action, ArmTransfer) and not (
                    action.object.isascii() and len(action.object) <= OBJECT_BYTES
                ):
                    yield (
                        f"{place}.object",
                        action.object,
                        f"permitted in an order: at most {OBJECT_BYTES} ASCII characters",
                    )
                if isinstance(action, ArmGoto) and len(action.joints or ()) > MAX_JOINTS:
                    yield (
                        f"{place}.joints",
                        list(action.joints or ()),
                        f"permitted in an order: at most {MAX_JOINTS} joints",
                    )
                arms.add(action.arm)
            latest = max([latest, *(action.by or 0.0 for action in step.do)])
