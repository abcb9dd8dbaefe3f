"""Shows contact forces as curves of wanted and exerted values."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rack.levels.algebra import Array
from rack.levels.systems.force.contact import AXIS_NAMES, UNITS
from rack.tools.viewer.stream import RowBlock, Stream, ViewPart
from rack.tools.viewer.style import COMMANDED, OVERLAID, build_curves, choose_joint_colours

FORCES = "forces"
CONTACT_UNITS = {"force": "N", "torque": "N m"}
"""Quantities of a contact, and their units."""
AXES = dict(zip(AXIS_NAMES, UNITS, strict=True))
"""Unit of each axis of a task frame."""


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

        yield build_curves(stream, (FORCES, axis), values, names, shades, OVERLAID)
