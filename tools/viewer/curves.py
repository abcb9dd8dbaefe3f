"""Curves of an arm with set points and limits, of a hand, of forces, and of any message."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import prod

import numpy as np

from rack.backplane.layout import FieldSpec
from rack.levels.algebra import Array, Ints
from rack.levels.messages import ArmState, Scene, WorldState
from rack.levels.robot.cell import Cell
from rack.levels.robot.hand import Hand
from rack.levels.systems.force.contact import AXIS_NAMES, UNITS
from rack.levels.systems.hand.messages import EXTENSOR, FLEXOR, HandStatus
from rack.levels.systems.joint_boards.messages import DRIVING, JointStatus, JointTorque
from rack.tools.viewer.stream import RowBlock, Stream, ViewPart
from rack.tools.viewer.style import (
    COMMANDED,
    LIMIT,
    OVERLAID,
    build_curves,
    choose_joint_colours,
    dim_colour,
    style_curves,
    write_legend,
)

SHOWN_IN_OTHER_VIEWS = (ArmState, Scene, WorldState, JointTorque, JointStatus, HandStatus)
NOT_AS_CURVES = {*DRIVING, *(message.message_type.name for message in SHOWN_IN_OTHER_VIEWS)}
"""Message types whose fields are not shown as separate curves."""
SIGNALS = "signals"
MAX_CURVES = 16
"""Largest number of curves of a field. Fields with more numbers have no curves."""
JOINTS = "joints"
ERROR = "tracking_error"
GRIPPER = ("opening", "grip_force")
"""Fields of the status of a board that drives an arm with a gripper."""
QUANTITIES = {"position": "rad", "velocity": "rad/s", "torque": "N m"}
"""Quantities of a joint, and their units. The torque is the torque after the limit gate."""
FIELDS = {
    "position": {"commanded": "target", "measured": "position"},
    "velocity": {"commanded": "target_velocity", "measured": "velocity"},
    "torque": {"applied": "torque"},
}
"""For each quantity of a joint, a dictionary from curve to field of the status."""
HAND = "hand"
TENSIONS = "tensions"
FINGER_FORCES = "forces"
BY_FINGER = {TENSIONS: "N", JOINTS: "rad", FINGER_FORCES: "N"}
"""Curves of a finger, and their units."""
TIPS = (HAND, "tip_forces")
FORCES = "forces"
CONTACT_UNITS = {"force": "N", "torque": "N m"}
"""Quantities of a contact, and their units."""
AXES = dict(zip(AXIS_NAMES, UNITS, strict=True))
"""Unit of each axis of a task frame."""


def build_joint_curves(stream: Stream, names: Sequence[str], cell: Cell) -> Iterator[ViewPart]:
    """Yield the view parts that show the status of the board that drives the arm.

    These are curves of the measured and commanded values of each joint with their limits, and of
    the tracking errors.

    Args:
        stream: Stream to write to.
        names: Names of the joints.
        cell: Cell of the arm.
    """
    colours = choose_joint_colours(len(names))
    write_legend(stream, JOINTS, names, colours)
    bounds = cell.bounds
    limits = {
        "position": np.where(np.isfinite(bounds.position), bounds.position, np.nan),
        "velocity": np.column_stack((-bounds.velocity, bounds.velocity)),
        "torque": np.column_stack((-bounds.torque, bounds.torque)),
    }
    for index, name in enumerate(names):
        for quantity, fields in FIELDS.items():
            entity = (JOINTS, name, quantity)
            yield _build_limits(stream, (*entity, "limits"), limits[quantity][index])
            labels = [f"{name} {meaning}, {QUANTITIES[quantity]}" for meaning in fields]
            shades = [COMMANDED, colours[index]][-len(fields) :]

            def select_joint(
                block: RowBlock, index: int = index, fields: dict[str, str] = fields
            ) -> Array:
                """Return the values of the fields for one joint, shape (rows, fields)."""
                columns = [block.messages[field][:, index] for field in fields.values()]
                return np.stack(columns, axis=-1)

            yield build_curves(
                stream, entity, select_joint, labels, shades, OVERLAID[-len(fields) :]
            )
    labels = [f"{name}, mrad" for name in names]
    yield build_curves(
        stream,
        (ERROR,),
        lambda block: (block.messages["position"] - block.messages["target"]) * 1e3,
        labels,
        colours,
    )


def _build_limits(stream: Stream, entity: Sequence[str], limits: Array) -> ViewPart:
    """Return the view part that shows two limits as straight lines.

    The lines need points only at the first and the last row of each block.

    Args:
        stream: Stream to write to.
        entity: Entity of the lines.
        limits: Lower and upper limit, shape (2,).
    """
    style_curves(stream, entity, ["lower limit", "upper limit"], [LIMIT, LIMIT], [1.0, 1.0])
    return lambda block: stream.send_curves(
        entity, block.build_time_columns([0, -1]), np.tile(limits, (2, 1))
    )


def build_field_curves(
    stream: Stream, mailbox: str, fields: Iterable[FieldSpec]
) -> Iterator[ViewPart]:
    """Yield the view parts that show numeric fields of a mailbox as curves.

    This works for any message, so messages of the user's levels need no configuration.

    Args:
        stream: Stream to write to.
        mailbox: Name of the mailbox.
        fields: The fields. Those that are not numeric are left out.
    """
    for field in filter(has_curves, fields):
        unit = f", {unit}" if (unit := get_plotted_unit(field)) else ""
        places = [f"[{position}]" for position in range(prod(field.shape))] if field.shape else [""]
        names = [f"{mailbox}.{field.name}{place}{unit}" for place in places]
        entity = (SIGNALS, mailbox, field.name)

        def flatten(block: RowBlock, name: str = field.name) -> Array:
            """Return one column for each number, shape (rows, numbers)."""
            return np.asarray(block.messages[name], float).reshape(len(block.rows), -1)

        yield build_curves(stream, entity, flatten, names)


def has_curves(field: FieldSpec) -> bool:
    """Return whether the numbers of a field are shown as curves."""
    is_numeric = not field.fields and field.kind[1] in "iufb"
    return is_numeric and 0 < prod(field.shape) <= MAX_CURVES


def get_plotted_unit(field: FieldSpec) -> str:
    """Return the unit of a field as text, empty for a number without a unit."""
    return "" if field.unit == "1" else field.unit


def build_hand_curves(stream: Stream, names: Sequence[str], hand: Hand) -> Iterator[ViewPart]:
    """Yield the view parts that show a `HandStatus`.

    Args:
        stream: Stream to write to.
        names: Names of all joints of the hand.
        hand: The hand.
    """
    colours = choose_joint_colours(len(hand.names))
    write_legend(stream, HAND, hand.names, colours)
    for index, finger in enumerate(hand.names):
        yield from _build_finger_curves(
            stream, names, finger, index, np.flatnonzero(hand.fingers[index])
        )
    labels = [f"{finger}, N" for finger in hand.names]
    yield build_curves(
        stream, TIPS, lambda block: np.linalg.norm(block.messages["force"], axis=2), labels, colours
    )


def _build_finger_curves(
    stream: Stream, names: Sequence[str], finger: str, finger_index: int, joints: Ints
) -> Iterator[ViewPart]:
    """Yield the view parts that show joints, tensions and tip force of one finger.

    Args:
        stream: Stream to write to.
        names: Names of all joints of the hand.
        finger: Name of the finger.
        finger_index: Index of the finger.
        joints: Indices of the finger's joints.
    """
    joint_names = [names[joint] for joint in joints]
    colours = choose_joint_colours(len(joint_names))
    yield build_curves(
        stream,
        (HAND, finger, JOINTS),
        lambda block: block.messages["position"][:, joints],
        [f"{name}, rad" for name in joint_names],
        colours,
    )

    def stack_tensions(block: RowBlock) -> np.ndarray:
        """Return the finger's tensions in N, shape (rows, tensions).

        Commanded tensions precede sensed ones. In each group flexors precede extensors.
        """
        columns = [
            block.messages[field][:, row][:, joints]
            for field in ("wanted", "tension")
            for row in (FLEXOR, EXTENSOR)
        ]
        return np.hstack(columns)

    tendons = [f"{name} {row}" for row in ("flexor", "extensor") for name in joint_names]
    yield build_curves(
        stream,
        (HAND, finger, TENSIONS),
        stack_tensions,
        [f"{tendon}{suffix}, N" for suffix in (" commanded", "") for tendon in tendons],
        [COMMANDED] * len(tendons) + colours + [dim_colour(colour) for colour in colours],
        np.repeat(OVERLAID, len(tendons)).tolist(),
    )
    yield build_curves(
        stream,
        (HAND, finger, FINGER_FORCES),
        lambda block: block.messages["force"][:, finger_index],
        [f"{axis}, N" for axis in "xyz"],
        choose_joint_colours(3),
    )


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
