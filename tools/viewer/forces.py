"""Contact forces: an arrow at each sensed place, and curves of wanted and exerted forces."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import mujoco
import numpy as np
import rerun as rr

from rack.levels.algebra import Array
from rack.levels.robot.cell import Cell
from rack.levels.systems.force.contact import AXIS_NAMES, UNITS
from rack.tools.viewer.stream import RowBlock, Stream, ViewPart, build_row_sampler
from rack.tools.viewer.style import COMMANDED, LIMIT, OVERLAID, build_curves, choose_joint_colour

ARROWS = ("cell", "forces")
FORCES = "forces"
TASK = "task_frame"
CONTACT = "contact"
"""Groups of curves: along the axes of a task frame, and of the contact force against its limits."""
CONTACT_UNITS = {"force": "N", "torque": "N m"}
"""Quantities of a contact, and their units."""
ARROW_COLOUR = 0x00E6FFFF
LONGEST_M = 1.0
TOOL_SHAFT_M = 0.014
"""Length of an arrow at the arm's limit on contacts, and its radius.

The length makes small forces visible beyond the tool.
"""
TIP_M = 0.02
TIP_SHAFT_M = 0.003
"""Length of an arrow at a fingertip per newton, and its radius."""
AXES = dict(zip(AXIS_NAMES, UNITS, strict=True))
"""Unit of each axis of a task frame."""


class ContactPlace(NamedTuple):
    """A place where forces are sensed.

    Attributes:
        name: Name of the place.
        site: Site at which it is.
        orientation_site: Site whose orientation the sensed vectors have, or None if they have the
            world's.
    """

    name: str
    site: int
    orientation_site: int | None

    @property
    def frame(self) -> str:
        """Name of the place's frame in the recording."""
        return f"contact/{self.name}"

    def compute_pose(self, data: mujoco.MjData) -> tuple[Array, Array]:
        """Return position, m, and quaternion of the frame in `data`."""
        quaternion = np.array([1.0, 0.0, 0.0, 0.0])
        if self.orientation_site is not None:
            mujoco.mju_mat2Quat(quaternion, data.site_xmat[self.orientation_site])
        return data.site_xpos[self.site], quaternion


def list_contacts(cell: Cell) -> list[ContactPlace]:
    """Return the places where a cell's forces are sensed.

    These are the tool on a wrist sensor, or the fingertips of a hand.
    """
    if cell.hand is not None:
        tips = zip(cell.hand.names, cell.hand.tips, strict=True)
        return [ContactPlace(name, int(tip), cell.tool) for name, tip in tips]
    return [] if cell.wrist is None else [ContactPlace("tool", cell.tool, None)]


def build_contact_arrows(stream: Stream, cell: Cell, field: str) -> ViewPart:
    """Return the part that shows the forces on the tool or on the fingertips as arrows.

    An arrow is drawn every 20 ms of simulated time.

    Args:
        stream: Where it is written.
        cell: The cell.
        field: Field of the message with three numbers for each place, and perhaps more after them.
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
        """Write the arrows of the rows that are drawn."""
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
    """Yield the parts that show a `ForceStatus` along the axes of the task frame.

    Each axis has a curve of the wanted value and one of the value that the tool exerts.
    """
    for index, (axis, unit) in enumerate(AXES.items()):
        names = [f"{axis} wanted, {unit}", f"{axis} exerted, {unit}"]
        values = partial(_select_wanted_and_exerted, index)
        shades = [COMMANDED, choose_joint_colour(index)]
        yield build_curves(stream, (FORCES, TASK, axis), values, names, shades, OVERLAID)


def _select_wanted_and_exerted(axis: int, block: RowBlock) -> Array:
    """Return both values along an axis, (rows, 2). Nothing is wanted on an axis of motion."""
    selected, wanted, wrench = (
        block.messages[field][:, axis] for field in ("selected", "wanted", "wrench")
    )
    return np.column_stack((np.where(selected == 1, wanted, np.nan), -wrench))


def build_contact_curves(stream: Stream, most: tuple[float, float]) -> Iterator[ViewPart]:
    """Yield the parts that show force and torque of a `Wrench`.

    Args:
        stream: Where they are written.
        most: The arm's limits on force, N, and torque, N m.
    """
    for index, (quantity, unit) in enumerate(CONTACT_UNITS.items()):
        names = [f"limit, {unit}", f"{quantity} of the contact, {unit}"]
        values = partial(_compute_limit_and_magnitude, most[index], 3 * index)
        yield build_curves(
            stream, (FORCES, CONTACT, quantity), values, names, [LIMIT, choose_joint_colour(0)]
        )


def _compute_limit_and_magnitude(limit: float, first: int, block: RowBlock) -> Array:
    """Return a limit, and the magnitude of three numbers of a wrench from `first` on, (rows, 2)."""
    size = np.linalg.norm(block.messages["wrench"][:, first : first + 3], axis=1)
    return np.column_stack((np.full(len(size), limit), size))
