"""What a rack knows of another one on the network: the mailbox `lan.peer_<rack>` of its adapter,
for levels to read.

A level that works together with another rack reads it with `Input(PEER, "lan.peer_<rack>")`:
whether that rack is there, and how its simulated time lies next to ours.
"""

from __future__ import annotations

from enum import IntEnum

from rack.backplane.message import Field, MessageType
from rack.levels.fields import number, real, tick

DRIFT_PPM = 100
"""Largest difference between the rates of two clocks: each crystal within 50 ppm."""


class Presence(IntEnum):
    """Where another rack is."""

    AWAITED = 0  # not seen yet
    THERE = 1
    LOST = 2


PEER = MessageType(
    "peer",
    1,
    (
        Field("presence", "u1", Presence, "awaited, there or lost"),
        Field(
            "launch",
            "i8",
            "1",
            "number of the launch that is there, or was last; 0: none, or in lockstep",
        ),
        number("launches", "its launches seen so far: a number above 1 means restarts"),
        number("losses", "how often it was lost"),
        tick("since", "since when it is there, or lost"),
        real("offset", "s", "its CLOCK_MONOTONIC less that of this machine; 0 in lockstep"),
        real(
            "uncertainty", "s", "largest error of the offset; -1: not measured yet; 0 in lockstep"
        ),
        real("round_trip", "s", "shortest recent round trip; -1: not measured yet; 0 in lockstep"),
        number(
            "steps",
            "how often its clock or ours was found to have stepped, as when a machine sleeps",
        ),
        real("ahead", "s", "its simulated time less that of this rack, at the same instant"),
        real("speed", "1", "its simulated seconds in a real one"),
    ),
)


def peer_port(rack: str) -> str:
    """Return the adapter's port for a rack: names of mailboxes have no hyphens."""
    return f"peer_{rack.replace('-', '_')}"
