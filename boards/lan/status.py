"""Status message of the network adapter, with counters of exports, imports and refusals."""

from __future__ import annotations

from collections.abc import Iterable

from rack.backplane.message import Message, Status, field, integer_field, make_message
from rack.boards.lan.envelope import MAX_MESSAGE_BYTES


class LanExport(Message, version=1):
    """Counters of one export in the status of the network adapter."""

    sent: int = integer_field("messages sent")
    serial: int = field(unit="1", doc="serial of the newest message sent, 0 if there is none")


class LanImport(Message, version=1):
    """Counters of one import, and its newest message, in the status of the network adapter."""

    taken: int = integer_field("messages passed to the backplane")
    missing: int = integer_field("messages that never arrived or arrived after a later one")
    disordered: int = integer_field(
        "messages that arrived after a later one and were not passed on"
    )
    repeated: int = integer_field("messages that arrived twice")
    late: int = integer_field("messages that were older than max_age_ms when they arrived")
    refused: int = integer_field(
        "messages refused because they are malformed, unsigned, oversized or of another type"
    )
    unknown_launch: int = integer_field("messages of a launch that is over, or not there")
    superseded: int = integer_field("messages that a newer one overtook before the exchange")
    launch: int = field(
        unit="1",
        doc="launch that wrote the newest message taken, 0 if there is none or in lockstep",
    )
    number: int = field(
        unit="1", doc="number of that message among all messages sent from its mailbox"
    )
    serial: int = field(unit="1", doc="its serial in its mailbox, 0 if there is none")
    age: int = field(
        unit="tick", doc="age of its information in this rack's ticks, -1 if there is none"
    )
    age_s: float = field(unit="s", doc="the same in simulated time, -1 if there is none")
    origin_s: float = field(
        unit="s", doc="when its oldest information arose, in simulated time of this rack"
    )


class LanFlaws(Message, version=1):
    """Counters of received messages that were dropped unread, by cause."""

    malformed: int = integer_field(
        "not of this protocol or of another version of it, always 0 in lockstep"
    )
    unsigned: int = integer_field(
        "changed on the way, under another key or not sealed by its sender, always 0 in lockstep"
    )
    oversized: int = integer_field(f"longer than {MAX_MESSAGE_BYTES} bytes, always 0 in lockstep")


class LanClocks(Message, version=1):
    """Counters of the round trips by which racks compare their clocks."""

    taken: int = integer_field("round trips measured")
    answered: int = integer_field("pings of other racks answered")
    withheld: int = integer_field(
        "pings not answered because they arrived too fast or from too many racks"
    )
    refused: int = integer_field(
        "pings and answers refused because they are malformed, unsigned or unexpected"
    )


class LanDesk(Message, version=1):
    """Counters of the emergency stops that other machines requested."""

    answered: int = integer_field(
        "emergency stops from other machines that were set, always 0 in lockstep"
    )
    refused: int = integer_field(
        "emergency stops refused because they are not permitted, always 0 in lockstep"
    )
    dropped: int = integer_field(
        "requests dropped: malformed, unsigned or oversized, always 0 in lockstep"
    )


def build_status_class(exports: Iterable[str], imports: Iterable[str]) -> type[Status]:
    """Build the message class of an adapter's status, with a group for each export and import."""
    groups = {
        "clocks": field(LanClocks, doc="round trips to compare clocks; none in lockstep"),
        **{f"export_{port}": field(LanExport, doc=f"export {port}") for port in exports},
        **{f"import_{port}": field(LanImport, doc=f"import {port}") for port in imports},
        "desk": field(LanDesk, doc="emergency stops from other machines"),
        "flaws": field(LanFlaws, doc="messages that were dropped unread, by cause"),
    }
    return make_message("lan_status", Status, groups)
