"""Forces of contacts: an arrow at each place where they are sensed, and curves of what is wanted
and exerted.
"""

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
from rack.tools.viewer.stream import RowBlock, Stream, ViewPart, row_sampler
from rack.tools.viewer.style import COMMANDED, LIMIT, OVERLAID, curves, of_joint

ARROWS = ("cell", "forces")
FORCES = "forces"
TASK = "task_frame"
CONTACT = "contact"
"""Groups of curves: along the axes of a task frame, of the whole contact against its limits."""
CONTACT_UNITS = {"force": "N", "torque": "N m"}
"""Quantities of a contact, and their units."""
ARROW_COLOUR = 0x00E6FFFF
LONGEST_M = 1.0
TOOL_SHAFT_M = 0.014
"""Length of an arrow at the limit of the arm on contacts, and its radius: a small force must show
beyond the tool."""
TIP_M = 0.02
TIP_SHAFT_M = 0.003
"""Length of an arrow at a fingertip for 1 N, and its radius."""
AXES = dict(zip(AXIS_NAMES, UNITS, strict=True))
"""Units, by axis of a task frame."""


class ContactPlace(NamedTuple):
    """A place where forces are sensed, and the frame in which its messages give them."""

    name: str
    site: int  # where it is
    turned: int | None  # site whose orientation the frame has; None: the world's

    @property
    def frame(self) -> str:
        """Name of the frame in the recording."""
        return f"contact/{self.name}"

    def pose(self, data: mujoco.MjData) -> tuple[Array, Array]:
        """Return place, m, and quaternion in `data`."""
        quaternion = np.array([1.0, 0.0, 0.0, 0.0])
        if self.turned is not None:
            mujoco.mju_mat2Quat(quaternion, data.site_xmat[self.turned])
        return data.site_xpos[self.site], quaternion


def contacts_of(cell: Cell) -> list[ContactPlace]:
    """Return the places where a cell's forces are sensed: the tool on a wrist sensor, the tips of a
    hand.
    """
    if cell.hand is not None:
        tips = zip(cell.hand.names, cell.hand.tips, strict=True)
        return [ContactPlace(name, int(tip), cell.tool) for name, tip in tips]
    return [] if cell.wrist is None else [ContactPlace("tool", cell.tool, None)]


def contact_arrows(stream: Stream, cell: Cell, field: str) -> ViewPart:
    """Return the part that writes the forces of the surroundings on tool or fingertips as arrows,
    one every 20 ms of simulated time; the numbers of `field` begin with three for each place.
    """
    scale, shaft = TIP_M, TIP_SHAFT_M
    if cell.wrist is not None:
        scale, shaft = LONGEST_M / cell.wrist.most[0], TOOL_SHAFT_M
    places = contacts_of(cell)
    for place in places:
        arrow = rr.Arrows3D.from_fields(colors=[ARROW_COLOUR], radii=shaft)
        stream.static((*ARROWS, place.name), arrow, stream.within(place.frame))
    sampled_rows = row_sampler(stream.times.clock_ns)

    def write(block: RowBlock) -> None:
        chosen = sampled_rows(block.ticks)
        if not len(chosen):
            return
        times = block.times_of(chosen)
        forces = block.messages[field][chosen].reshape(len(chosen), -1)
        for at, place in enumerate(places):
            vectors = scale * forces[:, 3 * at : 3 * at + 3]
            stream.columns((*ARROWS, place.name), times, rr.Arrows3D.columns(vectors=vectors))

    return write


def task_forces(stream: Stream) -> Iterator[ViewPart]:
    """Yield the parts that write a `ForceStatus`: what the tool exerts along each axis of the task
    frame, and what is wanted of it.
    """
    for at, (axis, unit) in enumerate(AXES.items()):
        names = [f"{axis} wanted, {unit}", f"{axis} exerted, {unit}"]
        values = partial(_wanted_and_exerted, at)
        shades = [COMMANDED, of_joint(at)]
        yield curves(stream, (FORCES, TASK, axis), values, names, shades, OVERLAID)


def _wanted_and_exerted(at: int, block: RowBlock) -> Array:
    """Return both along one axis, (rows, 2); nothing is wanted on an axis of motion."""
    selected, wanted, wrench = (
        block.messages[field][:, at] for field in ("selected", "wanted", "wrench")
    )
    return np.column_stack((np.where(selected == 1, wanted, np.nan), -wrench))


def contact_forces(stream: Stream, most: tuple[float, float]) -> Iterator[ViewPart]:
    """Yield the parts that write a `Wrench` as the size of force and torque, with the arm's
    limits, `most`.
    """
    for at, (what, unit) in enumerate(CONTACT_UNITS.items()):
        names = [f"limit, {unit}", f"{what} of the contact, {unit}"]
        values = partial(_limit_and_size, most[at], 3 * at)
        yield curves(stream, (FORCES, CONTACT, what), values, names, [LIMIT, of_joint(0)])


def _limit_and_size(limit: float, first: int, block: RowBlock) -> Array:
    size = np.linalg.norm(block.messages["wrench"][:, first : first + 3], axis=1)
    return np.column_stack((np.full(len(size), limit), size))
