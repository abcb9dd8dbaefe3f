"""What the servo level needs of an arm: sense, drive, and let time pass."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from backplane.message import Message

Array = NDArray[np.float64]


class Sensed(NamedTuple):
    """What the arm's sensors say now: joints (joints,), rad and rad/s; gripper, m and m/s, 0 without one."""

    position: Array
    velocity: Array
    opening: float
    opening_velocity: float


class Arm(Protocol):
    """An arm with torque-driven joints and a force-driven gripper.

    `tick` is the tick that its state belongs to. `torque` (joints,), N m, and `grip_force`, N, are what it was given
    last, behind the limit gate; `clipped` counts the cycles in which the gate cut a command. `fault` is empty, or says
    why the arm has stopped for good.
    """

    tick: int
    torque: Array
    grip_force: float
    clipped: int
    fault: str

    @property
    def touches(self) -> int:
        """Contacts that no task means."""

    @property
    def first_touch(self) -> str:
        """The first of them: what touched what, and when; empty: there was none."""

    def sense(self) -> Sensed:
        """Return what the sensors say. The arrays are valid until the next call."""

    def drive(self, torque: Array, grip_force: float) -> None:
        """Give torques (joints,), N m, and the gripper's force, N, for the coming cycle, through the limit gate."""

    def step(self, ticks: int) -> None:
        """Let `ticks` ticks pass."""

    def look(self, scene: Message) -> None:
        """Fill a `levels.messages.SCENE` with the poses of bodies and tool as sensed."""

    def save(self, state: Message) -> None:
        """Fill a `levels.messages.ARM_STATE` with all that the future depends on."""

    def restore(self, state: Message) -> None:
        """Go on from a `levels.messages.ARM_STATE`."""
