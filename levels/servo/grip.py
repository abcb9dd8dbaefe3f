"""The gripper's loop: a position loop whose force is limited by the command."""

from __future__ import annotations

import math

from rack.backplane.message import Message
from rack.levels.robot import GripperConfig


class Grip:
    """Gives the gripper's force, N: a spring and damper to the commanded opening, cut at the commanded force.

    Until a set point comes the gripper opens, or, with `keep`, goes on with the force that it has.
    """

    def __init__(self, config: GripperConfig) -> None:
        self._config = config
        self._least, self._most = sorted((config.open, config.closed))
        self._opening, self._limit = config.open, config.force
        self._kept: float | None = None

    def keep(self, force: float) -> None:
        """Go on with `force`, N, until a set point comes: what is held must survive a restart of its board."""
        self._kept = force

    def force(self, command: Message, opening: float, velocity: float) -> float:
        """Return the force, N, at `opening`, m, and its `velocity`, m/s, given the newest `JOINT_SET_POINT`."""
        if command.due != 0 and math.isfinite(command.opening) and math.isfinite(command.force):
            self._opening = min(max(command.opening, self._least), self._most)
            self._limit = min(max(command.force, 0.0), self._config.force)
            self._kept = None
        if self._kept is not None:
            return self._kept
        force = self._config.stiffness * (self._opening - opening) - self._config.damping * velocity
        return min(max(force, -self._limit), self._limit)
