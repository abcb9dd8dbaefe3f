"""A client of the force and motion server, for programs on a host board.

It offers these calls in addition to the calls of `Motions`. Task frames and contacts have names in
`[task]`, which is checked before the launch.

    comply("wipe")                 later motions have the axes of force of [task.contact.wipe]
    comply("wipe", wrench={"z": 20.0})       the same with another force
    guard("touch")                 the next of its wrenches ends the motion under way
    free()                         motion alone, without guards
    wrench(), mode()               wrench of the tool, N, N m, by axis; mode of the server

A guard that has ended a request is removed; `end_of(request)` is then GUARDED. Calls that wait also
send signs of life to the server. If a program makes no call for longer than `silence`, the server
treats it as lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from pydantic import ValidationError, model_validator

from rack.levels.algebra import Array, norm
from rack.levels.errors import LevelError
from rack.levels.host_program import Bus, HostReceiver, HostSender, ProgramInput, ProgramOutput
from rack.levels.level import LevelContext, Mismatches, Program
from rack.levels.systems.force.contact import (
    AXIS_NAMES,
    Axis,
    WantedContact,
    check_frame_and_wrenches,
)
from rack.levels.systems.force.messages import Mode, ServerRequest, ServerStatus
from rack.levels.systems.trajectory.commands import CommandEnvironment, Motions
from rack.levels.systems.trajectory.messages import MotionKind
from rack.levels.tables import (
    Finite,
    Positive,
    RobotConfig,
    SceneConfig,
    Table,
    Vector,
    describe_first_error,
)

SIGN_S = 0.1
"""Simulated time between signs of life."""
MAX_COSINE = 1e-3
"""Largest cosine of the angle between two axes that counts as a right angle."""


class FrameConfig(Table):
    """`[task.frame.<name>]`: a task frame, given by two of its axes in the world frame.

    The vectors may have any length.
    """

    x: Vector
    """its x axis"""
    z: Vector
    """its z axis, at a right angle to x"""

    @model_validator(mode="after")
    def _check_axes(self) -> FrameConfig:
        """Check that the axes define a frame."""
        lengths = norm(self.x) * norm(self.z)
        if not lengths > 0.0:
            raise ValueError("an axis of length 0: no frame")
        cosine = float((np.array(self.x) * self.z).sum()) / lengths
        if abs(cosine) > MAX_COSINE:
            raise ValueError("its axes x and z are not at a right angle: no frame")
        return self

    @property
    def quaternion(self) -> Array:
        """Orientation of the frame in the world, (4,), w, x, y, z."""
        x = np.array(self.x) / norm(self.x)
        z = np.array(self.z) / norm(self.z)
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.column_stack((x, np.cross(z, x), z)).ravel())
        return quaternion


class ContactConfig(Table):
    """`[task.contact.<name>]`: a contact for the calls `comply` and `guard`.

    Axes without a wrench are axes of motion.
    """

    frame: str
    """task frame"""
    wrench: dict[Axis, Finite] = {}
    """wrench of the tool on the surroundings on axes of force [N or N m]; by axis"""
    speed: dict[Axis, Positive] = {}
    """largest velocity on axes of force [m/s or rad/s]; by axis; default: the server's"""
    guard: dict[Axis, Positive] = {}
    """wrench, in either direction, that ends a motion [N or N m]; by axis"""


class ForceProgram(Program):
    """`[task]` of a client that requests forces and motions from a `ForceServer`."""

    frame: dict[str, FrameConfig] = {}
    """task frames, by name"""
    contact: dict[str, ContactConfig] = {}
    """contacts, by name"""

    def find_mismatches(self, robot: RobotConfig | None, scene: SceneConfig) -> Mismatches:
        """Yield contacts in unknown frames or beyond the limits of the arm."""
        for name, contact in self.contact.items():
            if reason := self.find_contact_error(contact, robot):
                yield f"contact.{name}", contact.model_dump(exclude_defaults=True), reason

    def find_contact_error(self, contact: ContactConfig, robot: RobotConfig | None) -> str:
        """Return the reason why a contact is invalid, or an empty string if it is valid.

        The program must define its frame, only force-controlled axes may have a speed, and its
        wrenches must be within the limits of the arm.
        """
        if contact.frame not in self.frame:
            return (
                f"frame '{contact.frame}' is not in [task.frame]; valid values:"
                f" {', '.join(self.frame) or 'none'}"
            )
        if robot is None or robot.wrist is None:
            return "the arm has no wrist sensor"
        if idle := [axis for axis in contact.speed if axis not in contact.wrench]:
            return (
                f"axis {idle[0]} has a speed and no force; axes of force:"
                f" {', '.join(contact.wrench) or 'none'}"
            )
        wanted = self.build_contact(contact)
        return check_frame_and_wrenches(
            wanted.frame,
            (wanted.wrench, wanted.guard),
            (robot.wrist.most_force, robot.wrist.most_torque),
        )

    def build_contact(self, contact: ContactConfig) -> WantedContact:
        """Convert a contact of the config to the values of a request."""
        return WantedContact(
            frame=self.frame[contact.frame].quaternion,
            selected=np.array([name in contact.wrench for name in AXIS_NAMES]),
            wrench=to_vector(contact.wrench),
            speed=to_vector(contact.speed),
            guard=to_vector(contact.guard),
        )


def to_vector(values: Mapping[Axis, float]) -> Array:
    """Convert a mapping from axes to values to a vector, (6,), with 0 for missing axes."""
    return np.array([values.get(name, 0.0) for name in AXIS_NAMES])


class ForceMotions(Motions):
    """Calls that request forces and motions from the server.

    A call raises `LevelError` at once if its contact is invalid.
    """

    def __init__(
        self,
        bus: Bus,
        motion: HostReceiver[ServerStatus],
        requests: HostSender[ServerRequest],
        context: LevelContext,
    ) -> None:
        self._server = motion
        self._program = ForceProgram.model_validate(dict(context.task))
        self._sign_ticks = round(SIGN_S / context.tick_s)
        self._signed = bus.tick  # tick of the last sign of life
        super().__init__(bus, motion, requests, context)

    def comply(self, contact: str, **changes: Any) -> int:
        """Request force control on the axes for which a contact has a wrench.

        It begins once the arm is at rest. The request is done when the forces have settled at the
        wanted values.

        Args:
            contact: Name of the contact.
            **changes: Entries of the contact to replace.

        Returns:
            Number of the request.
        """
        wanted = self._read_contact("comply", contact, changes)
        if not wanted.selected.any():
            raise LevelError(
                f"comply: contact '{contact}' has no axis of force; free() ends compliance"
            )
        fields = wanted._asdict()
        del fields["guard"]
        return self._queue_request(kind=MotionKind.COMPLY, **fields)

    def guard(self, contact: str, **changes: Any) -> int:
        """Request guards on axes: a wrench beyond the limit of an axis ends the motion under way.

        Args:
            contact: Name of the contact that contains the limits.
            **changes: Entries of the contact to replace.

        Returns:
            Number of the request.
        """
        wanted = self._read_contact("guard", contact, changes)
        if not wanted.guard.any():
            raise LevelError(f"guard: contact '{contact}' guards no axis")
        return self._queue_request(kind=MotionKind.GUARD, frame=wanted.frame, guard=wanted.guard)

    def free(self) -> int:
        """Request the end of compliance and guards. The request is done when the arm is at rest.

        Returns:
            Number of the request.
        """
        return self._queue_request(kind=MotionKind.COMPLY)

    @property
    def _status(self) -> ServerStatus:
        """Newest status of the server."""
        return self._server.read().message

    def wrench(self) -> Mapping[str, float]:
        """Return the wrench of the tool on the surroundings: N or N m for each axis name."""
        values = self._status.wrench
        return {
            name: round(float(value), 3) for name, value in zip(AXIS_NAMES, values, strict=True)
        }

    def mode(self) -> Mode:
        """Return the present mode of the server."""
        return Mode(self._status.mode)

    def where(self) -> list[float]:
        """Return the sensed position of the tool, in m."""
        return [round(float(x), 4) for x in self._status.place]

    def _read_contact(self, call: str, name: str, changes: Mapping[str, Any]) -> WantedContact:
        """Return a contact of the program, with some entries replaced.

        Args:
            call: Name of the call, for messages.
            name: Name of the contact.
            changes: Entries of the contact to replace.

        Raises:
            LevelError: There is no such contact, or it is invalid.
        """
        contact = self._program.contact.get(name)
        if contact is None:
            known = ", ".join(self._program.contact) or "none"
            raise LevelError(
                f"{call}: contact '{name}' is not in [task.contact]; valid values: {known}"
            )
        try:
            changed = ContactConfig(**{**contact.model_dump(), **changes})
        except ValidationError as error:
            raise LevelError(f"{call}: {describe_first_error(error)}") from error
        if reason := self._program.find_contact_error(changed, self._robot):
            raise LevelError(f"{call}: contact '{name}': {reason}")
        return self._program.build_contact(changed)

    def _wait_and_resend(self) -> None:
        """Wait as the base class does, and send a sign of life if one is due."""
        if self._bus.tick - self._signed >= self._sign_ticks:
            self._signed = self._bus.tick
            self._send_request({"id": 0})
        super()._wait_and_resend()


class ForceClient(CommandEnvironment):
    """Runs a script that commands forces and motions by name; a prompt offers the same names."""

    motion = ProgramInput(ServerStatus, "below.motion")
    requests = ProgramOutput(ServerRequest)
    program = ForceProgram

    def motions(self, bus: Bus) -> Motions:
        """Return the object that turns calls into requests."""
        return ForceMotions(bus, self.motion, self.requests, self.context)
