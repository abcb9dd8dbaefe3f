"""Bodies that several racks simulate. Each rack has a copy, and one rack at a time moves the body.

The simulations exchange only a mailbox, `servo.shared`, up to 50 times a second. A body belongs to
the rack whose gripper was the last to touch it. The simulation of that rack moves the body, and the
copies in the other racks stay at the pose that it reports. The first touch claims the body with the
next number. Of two claims the one with the greater number wins. If the numbers are equal, the rack
whose name is greater wins, so racks that have read the same messages agree. Until somebody touches
a body, every simulation moves its own copy.

The model covers one body in one place that arms carry one after the other. It does not cover forces
between the arms of two racks, directly or through a body that both touch; the program must keep the
arms apart. A copy is as late as the messages are, and stays where it is when none arrive any more.
A rack that is launched again takes over the claims that the others know, including the ones of its
earlier launch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rack.backplane.message import Message, field, integer_field
from rack.levels.algebra import Array

MAX_SHARED = 4
"""Maximum number of bodies that a rack shares. The message has the same layout in every rack."""
NAME_BYTES = 40
MAX_CLAIM = (1 << 32) - 1
MAX_DISTANCE_M = 1e3
"""Largest valid distance from the origin. The simulation gives up bodies much farther away."""


class SharedBodyEntry(Message, version=1, message="shared_body"):
    """One body that several racks share."""

    name: str = field(f"S{NAME_BYTES}", doc="name of the body in the model, empty if there is none")
    claim: int = integer_field(
        "number of the claim that this rack knows to be valid, 0 if there is none"
    )
    owner: str = field(
        f"S{NAME_BYTES}", doc="rack that made the claim, whose simulation moves the body"
    )
    touched: bool = field(doc="whether the gripper of this rack touches it")
    position: np.ndarray = field(
        unit="m", doc="body origin in this rack's simulation", shape=3, length=(0.0, MAX_DISTANCE_M)
    )
    quaternion: np.ndarray = field(
        unit="1", doc="body orientation in this rack's simulation", shape=4, length=(0.999, 1.001)
    )


class SharedBodies(Message, version=1):
    """The bodies that a rack shares with others."""

    rack: str = field(f"S{NAME_BYTES}", doc="rack that writes this")
    bodies: np.ndarray = field(SharedBodyEntry, doc="the bodies that it shares", shape=MAX_SHARED)


class Claim(NamedTuple):
    """Claim to a body: a number and the rack that made it. The greater of two claims wins."""

    number: int = 0
    owner: bytes = b""


UNCLAIMED = Claim()


@dataclass
class SharedBody:
    """State of one shared body in one rack.

    Attributes:
        name: Name of the body.
        rack: Name of this rack.
        claim: Newest claim that this rack knows.
        is_touched: Whether the gripper of this rack touches the body.
    """

    name: bytes
    rack: bytes
    claim: Claim = UNCLAIMED
    is_touched: bool = False

    @property
    def is_moved_elsewhere(self) -> bool:
        """Whether the simulation of another rack moves the body."""
        return self.claim.owner not in (b"", self.rack)

    def update_touch(self, touches: bool) -> None:
        """Update whether this rack's gripper touches the body. A new touch claims the body."""
        if touches and not self.is_touched and self.claim.owner != self.rack:
            self.claim = Claim(min(self.claim.number + 1, MAX_CLAIM), self.rack)
        self.is_touched = touches

    def process_message(self, message: SharedBodies) -> Array | None:
        """Update the claim from another rack's message, and return the pose for the copy.

        A greater claim is accepted from any rack, an equal claim only from its owner.

        Returns:
            The new pose of the body, (7,): position in m and quaternion. None if the message does
            not move it.
        """
        for entry in message.bodies[message.bodies["name"] == self.name]:
            claim = Claim(int(entry["claim"]), bytes(entry["owner"]))
            if claim > self.claim or (
                claim == self.claim
                and self.is_moved_elsewhere
                and message.record["rack"] == claim.owner
            ):
                self.claim = claim
                return np.concatenate((entry["position"], entry["quaternion"]))
        return None

    def restore_state(self, message: SharedBodies) -> None:
        """Restore the state from this rack's own last message, after a restart of the board."""
        for entry in message.bodies[message.bodies["name"] == self.name]:
            self.claim = Claim(int(entry["claim"]), bytes(entry["owner"]))
            self.is_touched = bool(entry["touched"])

    def write_entry(self, record: np.void, pose: Array) -> None:
        """Write the state into a `SharedBodyEntry`.

        Args:
            record: The entry.
            pose: Pose in this rack's simulation, (7,): position in m and quaternion.
        """
        record["name"] = self.name
        record["touched"] = self.is_touched
        record["claim"] = self.claim.number
        record["owner"] = self.claim.owner
        record["position"] = pose[:3]
        record["quaternion"] = pose[3:]
