"""Curves of a hand: joints, tensions and tip force of each finger."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rack.levels.algebra import Ints
from rack.levels.robot.hand import Hand
from rack.levels.systems.hand.messages import EXTENSOR, FLEXOR
from rack.tools.viewer.stream import RowBlock, Stream, ViewPart
from rack.tools.viewer.style import (
    COMMANDED,
    OVERLAID,
    build_curves,
    choose_joint_colours,
    dim_colour,
    write_legend,
)

HAND = "hand"
JOINTS = "joints"
TENSIONS = "tensions"
FORCES = "forces"
BY_FINGER = {TENSIONS: "N", JOINTS: "rad", FORCES: "N"}
"""Curves of a finger, and their units."""
TIPS = (HAND, "tip_forces")


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
        (HAND, finger, FORCES),
        lambda block: block.messages["force"][:, finger_index],
        [f"{axis}, N" for axis in "xyz"],
        choose_joint_colours(3),
    )
