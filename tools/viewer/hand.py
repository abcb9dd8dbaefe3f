"""A hand: joints, tensions and tip forces by finger, as curves."""

from __future__ import annotations

import numpy as np

from rack.levels.robot.hand import Hand
from rack.levels.systems.hand.messages import EXTENSOR, FLEXOR
from rack.tools.viewer.stream import RowBlock, Stream
from rack.tools.viewer.style import COMMANDED, dimmed, of_joint, style_curves, write_legend

HAND = "hand"
JOINTS = "joints"
TENSIONS = "tensions"
FORCES = "forces"
BY_FINGER = {TENSIONS: "N", JOINTS: "rad", FORCES: "N"}
"""Curves of a finger, and their units."""
TIPS = (HAND, "tip_forces")


class HandCurves:
    """Writes a `HandStatus`: a finger's joints, tensions as sensed and as commanded, and the force
    on its tip."""

    def __init__(self, stream: Stream, names: tuple[str, ...], hand: Hand) -> None:
        """Show the joints `names` of a hand."""
        self._stream = stream
        self._fingers = {
            name: np.flatnonzero(hand.fingers[at]) for at, name in enumerate(hand.names)
        }
        for finger, joints in self._fingers.items():
            own = [names[joint] for joint in joints]
            colours = [of_joint(at) for at in range(len(own))]
            style_curves(stream, (HAND, finger, JOINTS), [f"{name}, rad" for name in own], colours)
            tendons = [f"{name} {row}" for row in ("flexor", "extensor") for name in own]
            count = len(tendons)
            labels = [f"{tendon} commanded, N" for tendon in tendons]
            labels += [f"{tendon}, N" for tendon in tendons]
            shades = [COMMANDED] * count + colours + [dimmed(colour) for colour in colours]
            # The lower ones are wider: they show on both sides where the two agree.
            widths = [2.5] * count + [1.0] * count
            style_curves(stream, (HAND, finger, TENSIONS), labels, shades, widths)
            axes = [f"{axis}, N" for axis in "xyz"]
            style_curves(stream, (HAND, finger, FORCES), axes, [of_joint(at) for at in range(3)])
        labels = [f"{finger}, N" for finger in self._fingers]
        colours = [of_joint(at) for at in range(len(labels))]
        style_curves(stream, TIPS, labels, colours)
        write_legend(stream, HAND, hand.names, colours)

    def write(self, block: RowBlock) -> None:
        """Write every cycle of the hand."""
        messages = block.messages
        times = block.times
        for at, (finger, joints) in enumerate(self._fingers.items()):
            self._stream.scalars((HAND, finger, JOINTS), times, messages["position"][:, joints])
            tensions = [
                messages[field][:, row][:, joints]
                for field in ("wanted", "tension")
                for row in (FLEXOR, EXTENSOR)
            ]
            self._stream.scalars((HAND, finger, TENSIONS), times, np.hstack(tensions))
            self._stream.scalars((HAND, finger, FORCES), times, messages["force"][:, at])
        self._stream.scalars(TIPS, times, np.sqrt((messages["force"] ** 2).sum(axis=2)))
