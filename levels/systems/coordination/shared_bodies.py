"""Bodies that several racks simulate: each rack has a copy of its own, and one of them at a time
moves the body.

All that passes between the simulations is a mailbox, `servo.shared`, up to 50 times a second. A
body belongs to the rack whose gripper has begun to touch it last: that rack's simulation moves it,
and the copies of the others stay where it reports the body to be. To begin to touch is to claim,
with the next number. Of two claims the one with the greater number stands, of two equal ones that
of the rack whose name comes last: all racks that have read the same messages agree. A body that
nobody has touched yet moves in every simulation by itself.

Modelled: one body in one place, carried by one arm after the other. Not modelled: forces between
arms of two racks, on each other or through a body that both touch; the program keeps the arms
apart. A copy is as late as the messages, and where none come any more it stays where it is. A rack
that is launched anew takes over what the others know, its own claims of before included.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rack.backplane.message import Message, field, integer
from rack.levels.algebra import Array

MOST_SHARED = 4
"""Bodies that one rack shares, at most: the message has the same layout in every rack."""
NAME_BYTES = 40
MOST_CLAIMS = (1 << 32) - 1
FARTHEST_M = 1e3
"""From the origin: the simulation gives up bodies that are farther away than it can count."""


class SharedBodyEntry(Message, version=1, message="shared_body"):
    """One body that several racks share."""

    name: str = field(f"S{NAME_BYTES}", doc="body, by its name in the model; empty: none")
    claim: int = integer("number of the claim that stands, as far as this rack knows; 0: none yet")
    owner: str = field(
        f"S{NAME_BYTES}", doc="rack whose claim that is: its simulation moves the body"
    )
    touched: bool = field(doc="1: the gripper of this rack touches it")
    position: np.ndarray = field(
        unit="m", doc="body origin in this rack's simulation", shape=3, length=(0.0, FARTHEST_M)
    )
    quaternion: np.ndarray = field(
        unit="1", doc="body orientation, likewise", shape=4, length=(0.999, 1.001)
    )


class SharedBodies(Message, version=1):
    """The bodies that a rack shares with others."""

    rack: str = field(f"S{NAME_BYTES}", doc="rack that writes this")
    bodies: np.ndarray = field(SharedBodyEntry, doc="the bodies that it shares", shape=MOST_SHARED)


class Claim(NamedTuple):
    """The claim to a body that stands: of two, the greater one."""

    number: int = 0
    owner: bytes = b""


UNCLAIMED = Claim()


@dataclass
class SharedBody:
    """What one rack, `rack`, knows of a body that it shares."""

    name: bytes
    rack: bytes
    claim: Claim = UNCLAIMED
    is_touched: bool = False

    @property
    def is_elsewhere(self) -> bool:
        """Whether the simulation of another rack moves it."""
        return self.claim.owner not in (b"", self.rack)

    def touch(self, touches: bool) -> None:
        """Claim the body if this rack's gripper begins to touch it."""
        if touches and not self.is_touched and self.claim.owner != self.rack:
            self.claim = Claim(min(self.claim.number + 1, MOST_CLAIMS), self.rack)
        self.is_touched = touches

    def hear(self, message: SharedBodies) -> Array | None:
        """Take what another rack says; return where the body is, (7,), m and quaternion; None:
        nothing new.

        What counts is a greater claim, whoever reports it, and after that the word of the owner.
        """
        for told in message.bodies[message.bodies["name"] == self.name]:
            claim = Claim(int(told["claim"]), bytes(told["owner"]))
            if claim > self.claim or (
                claim == self.claim and self.is_elsewhere and message.record["rack"] == claim.owner
            ):
                self.claim = claim
                return np.concatenate((told["position"], told["quaternion"]))
        return None

    def recall(self, message: SharedBodies) -> None:
        """Take over what this rack itself said last, after a restart of the board."""
        for told in message.bodies[message.bodies["name"] == self.name]:
            self.claim = Claim(int(told["claim"]), bytes(told["owner"]))
            self.is_touched = bool(told["touched"])

    def show(self, record: np.void, pose: Array) -> None:
        """Fill a `SharedBodyEntry`; `pose` (7,) is that of the own simulation."""
        record["name"] = self.name
        record["touched"] = self.is_touched
        record["claim"] = self.claim.number
        record["owner"] = self.claim.owner
        record["position"] = pose[:3]
        record["quaternion"] = pose[3:]
