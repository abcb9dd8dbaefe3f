"""What the servo level needs of an arm: sense, drive, brake, and let time pass."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.levels.level import Finding

Array = NDArray[np.float64]


class Sensed(NamedTuple):
    """What the arm's sensors say: joints (joints,), rad and rad/s; gripper, m and m/s, 0 without one.

    Of the joints it is as coarse and noisy as their encoders. `tick` is that of the sample.
    """

    position: Array
    velocity: Array
    opening: float
    opening_velocity: float
    tick: int


class Link(Protocol):
    """What lies between the servo level and an arm: samples come up, torques go down."""

    def sense(self) -> Sensed:
        """Return the newest sample. The arrays are valid until the next call."""

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Open the brakes and give torques (joints,), N m, and the gripper's force, N, through the limit gate.

        They hold for the coming tick. What no servo level may ask for is not given: the brakes close, and what was
        wrong is returned.
        """


class Arm(Link, Protocol):
    """An arm with torque-driven joints that have brakes, and a force-driven gripper.

    `tick` is the tick that its state belongs to. `torque` (joints,), N m, and `grip_force`, N, are what its motors were
    told last, behind the limit gate; `clipped` counts the cycles in which the gate cut a command. `waited` counts the
    ticks since the last command. `fault` is empty, or says why the arm has stopped for good.
    """

    tick: int
    torque: Array
    grip_force: float
    clipped: int
    waited: int
    fault: str

    @property
    def braked(self) -> bool:
        """Whether the brakes are closed."""

    @property
    def contact(self) -> tuple[int, int] | None:
        """The geoms of an unintended contact of the arm, or of what it holds, since the last `step` began."""

    @property
    def holds(self) -> bool:
        """Whether the gripper touches a part."""

    @property
    def leans(self) -> bool:
        """Whether the arm, or what it holds, touches anything else."""

    def named(self, contact: tuple[int, int]) -> str:
        """Return what touches what."""

    @property
    def touches(self) -> int:
        """Contacts that no task means."""

    @property
    def first_touch(self) -> str:
        """The first of them: what touched what, and when; empty: there was none."""

    @property
    def violations(self) -> int:
        """Steps of the simulation in which the arm's own drives broke a limit."""

    @property
    def pushed(self) -> int:
        """Steps in which what struck the arm pushed a joint beyond a limit of position or velocity."""

    @property
    def first_violation(self) -> str:
        """The first of them: which limit, by how much, and when; empty: there was none."""

    def brake(self) -> None:
        """Close the brakes: they stop and hold the joints, the motors give nothing. The gripper keeps its force."""

    def weaken(self, most: Array | None) -> None:
        """Let the motors give no more than `most` (joints,), N m, whatever they are told; None: they are sound."""

    def step(self, ticks: int) -> None:
        """Let `ticks` ticks pass."""

    def look(self, scene: Message) -> None:
        """Fill a `rack.levels.messages.SCENE` with the poses of bodies and tool as sensed."""

    def save(self, state: Message) -> None:
        """Fill in a `rack.levels.messages.ARM_STATE` all that the arm's future depends on."""

    def restore(self, state: Message) -> None:
        """Go on from a `rack.levels.messages.ARM_STATE`."""
