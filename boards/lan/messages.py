"""The status of a network adapter: its exchange, entry by entry. Of other racks see
`rack.levels.peer`."""

from __future__ import annotations

from collections.abc import Iterable

from rack.backplane.message import Field, MessageType, status


def _counts(**meanings: str) -> tuple[Field, ...]:
    """Return a field for each count: its name, and what is counted."""
    return tuple(Field(name, "u4", "1", meaning) for name, meaning in meanings.items())


EXPORT = MessageType(
    "lan_export",
    1,
    (
        *_counts(sent="messages sent"),
        Field("serial", "i8", "1", "serial of the newest message sent; 0: none"),
    ),
)
IMPORT = MessageType(
    "lan_import",
    1,
    (
        *_counts(
            taken="messages passed to the backplane",
            missing="messages sent that never came, or came after a later one",
            disordered="messages that came after a later one, and were not passed",
            repeated="messages that came twice",
            late="messages older than max_age_ms when they came",
            refused=(
                "messages refused: malformed, unsigned, oversized, or not what its type permits"
            ),
            unknown_launch="messages of a launch that is over, or not there",
            superseded="messages that a newer one overtook before the exchange",
        ),
        Field(
            "launch",
            "i8",
            "1",
            "number of the launch that wrote the newest message taken; 0: none, or in lockstep",
        ),
        Field("number", "i8", "1", "number of that message among those sent from its mailbox"),
        Field("serial", "i8", "1", "its serial in its mailbox; 0: none"),
        Field("age", "i8", "tick", "age of its information in this rack's ticks; -1: none yet"),
        Field("age_s", "f8", "s", "the same in simulated time; -1: none yet"),
    ),
)
FLAWS = MessageType(
    "lan_flaws",
    1,
    _counts(
        malformed="not of this protocol, or of another version of it; in lockstep always 0",
        unsigned="changed on the way, under another key, or not sealed by whom it names; likewise",
        oversized="longer than most_bytes; likewise",
    ),
)
CLOCKS = MessageType(
    "lan_clocks",
    1,
    _counts(
        taken="round trips measured",
        answered="pings of other racks answered",
        withheld="pings not answered: they came too fast, or from too many racks",
        refused="pings and answers refused: malformed, unsigned, or to nothing that was asked",
    ),
)
DESK = MessageType(
    "lan_desk",
    1,
    _counts(
        answered="emergency stops from other machines that were set; in lockstep always 0",
        refused="emergency stops refused: not permitted; likewise",
        dropped="requests dropped: malformed, unsigned or oversized; likewise",
    ),
)


def status_of(exports: Iterable[str], imports: Iterable[str]) -> MessageType:
    """Return the type of an adapter's status: a group for each export and import."""
    return status(
        "lan_status",
        1,
        Field("clocks", CLOCKS, "1", "round trips to compare clocks; none in lockstep"),
        *(Field(f"export_{port}", EXPORT, "1", f"export {port}") for port in exports),
        *(Field(f"import_{port}", IMPORT, "1", f"import {port}") for port in imports),
        Field("desk", DESK, "1", "emergency stops from other machines"),
        Field("flaws", FLAWS, "1", "all that came and was dropped unread, by cause"),
    )
