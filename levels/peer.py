"""State of another rack on the network, for levels to read.

A level that works together with another rack reads it with `Input(PeerPresence,
"lan.peer_<rack>")`, a mailbox of the network adapter. It shows whether that rack is present, and
the offset between its simulated time and ours.
"""

from __future__ import annotations

from enum import IntEnum

from rack.backplane.message import Message, field, integer_field

DRIFT_PPM = 100
"""Maximum difference between the rates of two clocks, since each crystal is within 50 ppm."""


class Presence(IntEnum):
    """Presence of another rack."""

    AWAITED = 0  # not seen yet
    THERE = 1
    LOST = 2


class PeerPresence(Message, version=1, message="peer"):
    """Presence and clock of another rack, written by the network adapter."""

    presence: Presence = field(doc="awaited, present or lost")
    launch: int = field(
        unit="1", doc="number of the present or last launch (0: none, or in lockstep)"
    )
    launches: int = integer_field("its launches seen so far: a number above 1 means restarts")
    losses: int = integer_field("how often it was lost")
    since: int = field(unit="tick", doc="tick since which it is present or lost")
    offset: float = field(unit="s", doc="its CLOCK_MONOTONIC minus ours; 0 in lockstep")
    uncertainty: float = field(
        unit="s", doc="largest error of the offset; -1 if not measured yet, 0 in lockstep"
    )
    round_trip: float = field(
        unit="s", doc="shortest recent round trip; -1 if not measured yet, 0 in lockstep"
    )
    steps: int = integer_field(
        "number of detected steps of its clock or ours, as when a machine sleeps"
    )
    ahead: float = field(unit="s", doc="its simulated time minus ours, at the same instant")
    speed: float = field(unit="1", doc="its simulated seconds per real second")


def format_peer_port(rack: str) -> str:
    """Return the name of the adapter's port for a rack.

    Hyphens become underscores, because names of mailboxes must not contain hyphens.
    """
    return f"peer_{rack.replace('-', '_')}"
