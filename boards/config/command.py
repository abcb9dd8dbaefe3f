"""`[[command]]` of a rack's config: an operator command to a level."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import StringConstraints

from rack.levels.operator import MAX_NAME_BYTES, Goal, Operation
from rack.levels.tables import Finite, Moment, Quaternion, Table, Tick, Vector


class CommandConfig(Table):
    """`[[command]]`: an operator command to a level."""

    level: str
    """board of the commanded level, such as servo or task"""
    what: Literal[
        "hold",
        "resume",
        "setpoint",
        "goto",
        "modify",
        "table",
        "do",
        "set",
        "schedule",
        "switch",
        "enable",
        "disable",
        "reset",
        "release",
    ]
    """hold: come to rest; resume: continue; setpoint, goto: move to a goal and stay there; modify:
    add or remove a control modification; table: switch to another state table; do: carry out one of
    the level's own commands; set: change a live parameter of the level; schedule: change the
    scheduler of its board; switch: hand over to a standby of its board; enable, disable: turn the
    torque of the arm on or off; reset: clear a fault of its drives; release: end
    robot.bring_up"""
    tick: Tick | None = None
    """tick at which the command is issued; give at most one of tick, at"""
    at: Moment | None = None
    """simulated time at which the command is issued [s]; instead of tick"""
    joints: tuple[Finite, ...] | None = None
    """goal: one position per joint [rad]"""
    position: Vector | None = None
    """goal: tool position [m]; needs quaternion or direction"""
    quaternion: Quaternion | None = None
    """goal: tool orientation as w, x, y, z"""
    direction: Vector | None = None
    """goal: direction of the tool's z axis, with any rotation about it; default: down"""
    home: bool = False
    """goal: the arm's start position"""
    name: Annotated[str, StringConstraints(max_length=MAX_NAME_BYTES)] | None = None
    """name of a control modification or of a state table; command to carry out, as in pick block1;
    parameter to set, as in bandwidth=80; scheduler"""
    on: bool | None = None
    """whether to add (true) or to remove (false) the control modification"""

    @property
    def operation(self) -> Operation:
        """The `Operation` that `what` names."""
        return Operation[self.what.upper()]

    @property
    def goals(self) -> list[Goal]:
        """Forms of the goals that the command gives. A valid command gives at most one."""
        goals = [Goal.JOINTS] if self.joints is not None else []
        if self.position is not None or self.quaternion is not None or self.direction is not None:
            goals.append(Goal.DIRECTION if self.quaternion is None else Goal.POSE)
        goals += [Goal.HOME] if self.home else []
        return goals if self.on is None else [*goals, Goal.ON if self.on else Goal.OFF]
