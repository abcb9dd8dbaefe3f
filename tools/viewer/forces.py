"""Shows contact forces: an arrow at each sensor, and curves of wanted and exerted forces."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np
import rerun as rr

from rack.levels.algebra import Array
from rack.levels.robot.cell import Cell
from rack.levels.systems.force.contact import AXIS_NAMES, UNITS
from rack.tools.viewer.stream import RowBlock, Stream, ViewPart, build_row_sampler
from rack.tools.viewer.style import COMMANDED, LIMIT, OVERLAID, build_curves, choose_joint_colours

ARROWS = ("cell", "forces")
FORCES = "forces"
TASK = "task_frame"
CONTACT = "contact"
"""Names of two groups of curves.

The first shows forces along the axes of the task frame, the second contact forces with limits.
"""
CONTACT_UNITS = {"force": "N", "torque": "N m"}
"""Quantities of a contact, and their units."""
ARROW_COLOUR = 0x00E6FFFF
LONGEST_M = 1.0
TOOL_SHAFT_M = 0.014
"""Length of an arrow for a contact force at the arm's limit, and radius of arrows.

The arrow is long, so that arrows of small forces also reach beyond the tool.
"""
TIP_M = 0.02
TIP_SHAFT_M = 0.003
"""Length per newton, and radius, of an arrow at a fingertip."""
AXES = dict(zip(AXIS_NAMES, UNITS, strict=True))
"""Unit of each axis of a task frame."""


class ContactPoint(NamedTuple):
    """A point on the tool or hand at which forces are sensed.

    Attributes:
        name: Name of the point.
        site: Index of the MuJoCo site at the point.
        orientation_site: Index of the site in whose axes the forces are given, or None if they are
            given in the axes of the world.
    """

    name: str
    site: int
    orientation_site: int | None

    @property
    def frame(self) -> str:
        """Name of the coordinate frame at the point, in which the arrow is drawn."""
        return f"contact/{self.name}"

    def compute_pose(self, data: mujoco.MjData) -> Array:
        """Return position in m and quaternion (w first) of the frame for the poses in `data`."""
        quaternion = np.array([1.0, 0.0, 0.0, 0.0])
        if self.orientation_site is not None:
            mujoco.mju_mat2Quat(quaternion, data.site_xmat[self.orientation_site])
        return np.concatenate((data.site_xpos[self.site], quaternion))


def list_contacts(cell: Cell) -> list[ContactPoint]:
    """Return the points at which the forces on a cell's tool or hand are sensed.

    These are the tool of an arm with a wrist sensor, or the fingertips of a hand.
    """
    if cell.hand is not None:
        tips = zip(cell.hand.names, cell.hand.tips, strict=True)
        return [ContactPoint(name, int(tip), cell.tool) for name, tip in tips]
    return [] if cell.wrist is None else [ContactPoint("tool", cell.tool, None)]


def build_contact_arrows(stream: Stream, cell: Cell, field: str) -> ViewPart:
    """Return the view part that shows the forces on the tool or on the fingertips as arrows.

    The arrows are drawn every 20 ms of simulated time.

    Args:
        stream: Stream to write to.
        cell: The cell.
        field: Field of the message. It begins with the force in N at each point of
            `list_contacts`, three numbers per point.
    """
    scale, shaft = TIP_M, TIP_SHAFT_M
    if cell.wrist is not None:
        scale, shaft = LONGEST_M / cell.wrist.contact_limits[0], TOOL_SHAFT_M
    places = list_contacts(cell)
    for place in places:
        arrow = rr.Arrows3D.from_fields(colors=[ARROW_COLOUR], radii=shaft)
        stream.log_static((*ARROWS, place.name), arrow, stream.build_frame(place.frame))
    sampled_rows = build_row_sampler(stream.times.clock_ns)

    def write(block: RowBlock) -> None:
        """Write the arrows for the first row of each drawing interval."""
        chosen = sampled_rows(block.ticks)
        if not len(chosen):
            return
        times = block.build_time_columns(chosen)
        forces = block.messages[field][chosen].reshape(len(chosen), -1)
        for index, place in enumerate(places):
            vectors = scale * forces[:, 3 * index : 3 * index + 3]
            stream.send_columns((*ARROWS, place.name), times, rr.Arrows3D.columns(vectors=vectors))

    return write


def build_task_force_curves(stream: Stream) -> Iterator[ViewPart]:
    """Yield the view parts that show the forces and torques in a `ForceStatus`.

    For each axis of the task frame there is a curve of the wanted value, and a curve of the value
    that the tool exerts.
    """
    for index, (axis, colour) in enumerate(zip(AXES, choose_joint_colours(6), strict=True)):
        names = [f"{axis} {what}, {AXES[axis]}" for what in ("wanted", "exerted")]
        shades = [COMMANDED, colour]

        def values(block: RowBlock, index: int = index) -> Array:
            """Return both values. Nothing is wanted while position is controlled, not force."""
            selected, wanted, wrench = (
                block.messages[field][:, index] for field in ("selected", "wanted", "wrench")
            )
            return np.column_stack((np.where(selected == 1, wanted, np.nan), -wrench))

        yield build_curves(stream, (FORCES, TASK, axis), values, names, shades, OVERLAID)


def build_contact_curves(stream: Stream, most: tuple[float, float]) -> Iterator[ViewPart]:
    """Yield the view parts that show force and torque in a `Wrench` with the arm's limits.

    Args:
        stream: Stream to write to.
        most: The arm's limits on the contact force in N and the contact torque in N m.
    """
    for index, (quantity, unit) in enumerate(CONTACT_UNITS.items()):
        names = [f"limit, {unit}", f"{quantity} of the contact, {unit}"]

        def values(block: RowBlock, index: int = index) -> Array:
            """Return the limit, and the magnitude of the force or torque."""
            wrench = block.messages["wrench"][:, 3 * index : 3 * index + 3]
            return np.column_stack(
                (np.full(len(wrench), most[index]), np.linalg.norm(wrench, axis=1))
            )

        yield build_curves(
            stream, (FORCES, CONTACT, quantity), values, names, [LIMIT, *choose_joint_colours(1)]
        )
