"""The base class of every arm: sense, drive, brake, and advance time.

The servo level drives the class that `[board.servo.params] arm = "package.module:Class"` names. The
default is the simulated arm; it may be your own hardware or simulation. In every cycle the servo
level calls, in this order: `step` (with the ticks since the last cycle), `sense`, one of `drive`
(`follow` for drives that take set points), `brake` or neither (the last command stays active),
`save` and `look`. All calls come from the executor's process, within its cycle, so none may block.
An exception ends the board, which is restarted as after any crash. Report a broken arm in `fault`
instead.
"""

from __future__ import annotations

from collections.abc import Callable

from rack.levels.arm.braked_arm import BrakedArm
from rack.levels.arm.faulty import FaultyLink
from rack.levels.arm.guard import GuardedArm, narrow_bounds_by_errors
from rack.levels.arm.latency_compensation import PresentLink
from rack.levels.arm.link import Link
from rack.levels.errors import RobotError
from rack.levels.messages import Scene
from rack.levels.robot.cell import Cell
from rack.levels.tables import SensorConfig


class Arm(BrakedArm):
    """Base class of every arm. A guard protects the arm, unless its drives enforce the limits.

    Subclasses write `sense`, `brake`, `step`, and `drive` or `follow`, depending on whether the
    drives take torques or set points. They keep the attributes of `BrakedArm` and `Plant` up to
    date. All other methods have defaults, which suit an arm without contact sensors whose state
    survives a restart of its board.
    """

    keeps_limits = False
    """True if the drives keep the limits, as the simulated arm's drives do.

    Every other arm is driven through `rack.levels.arm.guard.GuardedArm`.
    """
    sensors = SensorConfig(resolution=1e-4, noise=5e-5)
    """Default encoders.

    The resolution is 16 bits per turn. The noise covers samples that are taken up to 0.1 ms early
    or late, which is 0.3 mrad at 3 rad/s, six times this noise.
    """
    _guard: GuardedArm | None = None

    def connect(
        self,
        tick_s: float,
        speed_fraction: float,
        acted: dict[int, bool],
        holds: Callable[[], bool],
    ) -> FaultyLink:
        """Return the link through which the servo level drives the arm.

        Args:
            tick_s: Duration of a tick, s.
            speed_fraction: Fraction of the velocity limits that is permitted.
            acted: Receives the faults that have an effect, for `Executor.acted`.
            holds: Function that returns True if, as far as the level knows, the gripper may hold an
                object.

        Raises:
            RobotError: The encoders are too coarse to detect a violated limit.
        """
        encoders = self.cell.encoders
        is_present = encoders.offset is None and not encoders.latency_ticks
        link: Link = self if is_present else PresentLink(self, tick_s)
        if not self.keeps_limits:
            link = self._guard = GuardedArm(self, tick_s, link, speed_fraction)
        return FaultyLink(self, acted, link, holds)

    def permit_speed(self, speed_fraction: float) -> None:
        """Set the fraction of the velocity limits that the link permits."""
        if self._guard is not None:
            self._guard.permit_speed(speed_fraction)

    @classmethod
    def find_connect_error(cls, cell: Cell, speed_fraction: float) -> str:
        """Return the reason why `connect` would fail for a cell, or an empty string.

        Called before the launch.
        """
        try:
            narrow_bounds_by_errors(cell, speed_fraction)
        except RobotError as error:
            return str(error)
        return ""

    def look(self, scene: Scene) -> None:
        """Fill a `Scene` with the sensed poses of bodies and tool.

        By default, bodies have their initial poses, and the pose of the tool follows from the joint
        sensors.
        """
        offset = self.cell.encoders.offset
        position = self.sense().position
        self._data.qpos[self.cell.qpos] = position if offset is None else position + offset
        self._fill_scene(scene)
