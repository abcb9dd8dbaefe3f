"""The status of a network adapter: its exchange, entry by entry, and the other racks."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum

from rack.backplane.message import Field, MessageType, status


class Presence(IntEnum):
    """Where another rack is."""

    AWAITED = 0  # not seen yet
    THERE = 1
    LOST = 2


EXPORT = MessageType(
    "lan_export",
    1,
    (
        Field("sent", "u4", "1", "messages sent"),
        Field("serial", "i8", "1", "serial of the newest message sent; 0: none"),
    ),
)
IMPORT = MessageType(
    "lan_import",
    1,
    (
        Field("taken", "u4", "1", "messages passed to the backplane"),
        Field("missing", "u4", "1", "messages sent that never came, or came after a later one"),
        Field("repeated", "u4", "1", "messages that came twice, or after a later one"),
        Field("late", "u4", "1", "messages older than max_age_ms when they came"),
        Field("refused", "u4", "1", "messages refused: malformed, unsigned, oversized, NaN, or of another type"),
        Field("strange", "u4", "1", "messages of a launch that is over, or not known yet"),
        Field("overtaken", "u4", "1", "messages that a newer one overtook before the exchange"),
        Field("serial", "i8", "1", "serial of the newest message passed; 0: none"),
        Field("age", "i8", "tick", "age of its information in this rack's ticks; -1: none yet"),
        Field("age_s", "f8", "s", "the same in simulated time; -1: none yet"),
    ),
)
PEER = MessageType(
    "lan_peer",
    1,
    (
        Field("presence", "u1", Presence, "awaited, there or lost"),
        Field("launches", "u4", "1", "its launches seen so far: a number above 1 means restarts"),
        Field("losses", "u4", "1", "how often it was lost"),
        Field("since", "i8", "tick", "since when it is there, or lost"),
        Field("offset", "f8", "s", "its CLOCK_MONOTONIC less that of this machine; 0 in lockstep"),
        Field("uncertainty", "f8", "s", "largest error of the offset; -1: not measured yet; 0 in lockstep"),
        Field("round_trip", "f8", "s", "shortest recent round trip; -1: not measured yet; 0 in lockstep"),
        Field("ahead", "f8", "s", "its simulated time less that of this rack, at the same instant"),
        Field("speed", "f8", "1", "its simulated seconds in a real one"),
    ),
)


def peer_port(rack: str) -> str:
    """Return the name of a rack's group in the status: field names have no hyphens."""
    return f"peer_{rack.replace('-', '_')}"


def status_of(exports: Iterable[str], imports: Iterable[str], peers: Iterable[str]) -> MessageType:
    """Return the type of an adapter's status: a group for each export, import and other rack."""
    return status(
        "lan_status",
        1,
        *(Field(f"export_{port}", EXPORT, "1", f"export {port}") for port in exports),
        *(Field(f"import_{port}", IMPORT, "1", f"import {port}") for port in imports),
        *(Field(peer_port(rack), PEER, "1", f"rack {rack}") for rack in peers),
    )
