"""The seam between the servo level and an arm: sense, drive, brake, and let time pass.

The servo level drives whatever class `[board.servo.params] arm = "package.module:Class"` names: the
simulated arm by default, your own hardware or simulation otherwise. In every cycle it calls, in
this order, `step` (the ticks since the last cycle), `sense`, then either `drive` (`follow` for
drives that take set points) or `brake` or neither (the last command stays in force), `save` and
`look`. All calls come from the executor's process, within its cycle: none may block. An exception
ends the board, which is restarted as after any crash; report a broken arm in `fault` instead.
"""

from __future__ import annotations

from collections.abc import Callable

from rack.levels.arm.braked_arm import BrakedArm
from rack.levels.arm.drivable import ArmLinks
from rack.levels.arm.faulty import FaultyLink
from rack.levels.arm.guard import GuardedArm, kept_bounds
from rack.levels.arm.latency_compensation import present_link
from rack.levels.errors import RobotError
from rack.levels.messages import Scene
from rack.levels.robot.cell import Cell
from rack.levels.tables import SensorConfig


class Arm(BrakedArm):
    """Base of every arm: it is guarded, unless its drives keep its limits.

    Subclasses write `sense`, `brake`, `step` and, as their drives take torques or set points,
    `drive` or `follow`, and keep the attributes of `DrivableArm` up to date. All else has a default
    that suits an arm without contact sensors, whose state outlives its board.
    """

    keeps_limits = False
    """The simulated arm's drives do. Every other arm is driven through
    `rack.levels.arm.guard.GuardedArm`."""
    sensors = SensorConfig(resolution=1e-4, noise=5e-5)
    """Default: 16 bits a turn; and samples that are taken up to 0.1 ms early or late, which is 0.3
    mrad at 3 rad/s, six times this noise."""
    _guard: GuardedArm | None = None

    def connect(
        self, tick_s: float, part: float, acted: dict[int, bool], holds: Callable[[], bool]
    ) -> ArmLinks:
        """Return the path that the servo level drives it through; see `DrivableArm.connect`."""
        link = present_link(self, tick_s)
        if not self.keeps_limits:
            link = self._guard = GuardedArm(self, tick_s, link, part)
        return ArmLinks(link, FaultyLink(self, acted, link, holds))

    def permit(self, part: float) -> None:
        """Let the path keep velocities within another `part` of their limits."""
        if self._guard is not None:
            self._guard.permit(part)

    @classmethod
    def misfit(cls, cell: Cell, part: float) -> str:
        """Return why `connect` would fail for a cell, before the launch; empty: it would not."""
        try:
            if not cls.keeps_limits:
                kept_bounds(cell, part)
        except RobotError as error:
            return str(error)
        return ""

    def look(self, scene: Scene) -> None:
        """Fill a `SCENE` with the poses of bodies and tool. Default: bodies at their start, the
        tool as sensed.
        """
        offset = self.cell.encoders.offset
        position = self.sense().position
        self._data.qpos[self.cell.qpos] = position if offset is None else position + offset
        self._show(scene)
