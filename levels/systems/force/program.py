"""The client's part of `[task]`: task frames and contacts by name, checked before the launch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
from pydantic import Field

from rack.levels.algebra import Array, norm
from rack.levels.level import Program
from rack.levels.systems.force.contact import AXIS_NAMES, Axis, Wanted, misfit
from rack.levels.tables import Finite, Positive, RobotConfig, SceneConfig, Table, Vector

MAX_COSINE = 1e-3
"""Axes that are closer to a right angle than this span a frame."""


class FrameConfig(Table):
    """`[task.frame.<name>]`: a task frame by two of its axes, in the world's frame, of any
    length."""

    x: Vector = Field(description="its x axis")
    z: Vector = Field(description="its z axis, at a right angle to x")

    def objection(self) -> str:
        """Return why the axes are no frame; empty: they are one."""
        lengths = norm(self.x) * norm(self.z)
        if not lengths > 0.0:
            return "an axis of length 0: no frame"
        cosine = float((np.array(self.x) * self.z).sum()) / lengths
        if abs(cosine) > MAX_COSINE:
            return "its axes x and z are not at a right angle: no frame"
        return ""

    @property
    def quaternion(self) -> Array:
        """Orientation of the frame in the world, (4,), w, x, y, z."""
        x = np.array(self.x) / norm(self.x)
        z = np.array(self.z) / norm(self.z)
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.column_stack((x, np.cross(z, x), z)).ravel())
        return quaternion


class ContactConfig(Table):
    """`[task.contact.<name>]`: a contact for the calls `comply` and `guard`; axes that are not
    named are of motion."""

    frame: str = Field(description="task frame")
    wrench: dict[Axis, Finite] = Field(
        {}, description="of the tool on the surroundings on axes of force, N or N m; by axis"
    )
    speed: dict[Axis, Positive] = Field(
        {}, description="most on an axis of force, m/s or rad/s; by axis; default: the server's"
    )
    guard: dict[Axis, Positive] = Field(
        {}, description="wrench, either way, that ends a motion, N or N m; by axis"
    )


class ForceProgram(Program):
    """`[task]` of a client of a server of force and motion."""

    frame: dict[str, FrameConfig] = Field({}, description="task frames, by name")
    contact: dict[str, ContactConfig] = Field({}, description="contacts, by name")

    def misfits(
        self, robot: RobotConfig | None, scene: SceneConfig
    ) -> Iterable[tuple[str, Any, str]]:
        """Yield frames that are none, and contacts in no frame, or beyond the limits of arm and
        sensor."""
        bent = {name: reason for name, frame in self.frame.items() if (reason := frame.objection())}
        for name, reason in bent.items():
            yield f"frame.{name}", self.frame[name].model_dump(), reason
        for name, contact in self.contact.items():
            if contact.frame not in bent and (reason := self.objection(contact, robot)):
                yield f"contact.{name}", contact.model_dump(exclude_defaults=True), reason

    def objection(self, contact: ContactConfig, robot: RobotConfig | None) -> str:
        """Return why a contact is impossible; empty: it is not."""
        if contact.frame not in self.frame:
            return (
                f"frame '{contact.frame}' is not in [task.frame]; permitted:"
                f" {', '.join(self.frame) or 'none'}"
            )
        if robot is None or robot.wrist is None:
            return "the arm has no wrist sensor"
        if idle := [axis for axis in contact.speed if axis not in contact.wrench]:
            return (
                f"axis {idle[0]} has a speed and no force; axes of force:"
                f" {', '.join(contact.wrench) or 'none'}"
            )
        wanted = self.wanted(contact)
        return misfit(
            wanted.frame,
            (wanted.wrench, wanted.guard),
            (robot.wrist.most_force, robot.wrist.most_torque),
        )

    def wanted(self, contact: ContactConfig) -> Wanted:
        """Return a contact as the numbers of a request."""
        return Wanted(
            frame=self.frame[contact.frame].quaternion,
            selected=np.array([name in contact.wrench for name in AXIS_NAMES]),
            wrench=by_axis(contact.wrench),
            speed=by_axis(contact.speed),
            guard=by_axis(contact.guard),
        )


def by_axis(values: Mapping[Axis, float]) -> Array:
    """Return values by axis as a vector, (6,); 0 for axes that are not named."""
    return np.array([values.get(name, 0.0) for name in AXIS_NAMES])
