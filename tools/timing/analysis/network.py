"""The section of a report on the network: what passed over it, how old it was, and which racks were
lost."""

from __future__ import annotations

from typing import Any

from rack.levels.peer import Presence, peer_port
from rack.levels.timing.trace_times import distribution
from rack.tools.live.network import BOARD, COUNTS, STATUS, exchanged
from rack.tools.recording.recording import Recording

Report = dict[str, Any]


def network(recording: Recording) -> Report | None:
    """Return counts and ages, ms, of what passed, and losses of other racks; None: no adapter, or
    nothing recorded."""
    entries = exchanged(recording.config)
    if entries is None or STATUS not in recording.mailboxes:
        return None

    def last(field: str) -> int:
        return int(recording.signal(STATUS, field)[-1])

    imports = []
    for port, source in entries.imports.items():
        ages_s = recording.signal(STATUS, f"import_{port}.age_s")
        counts = {name: last(f"import_{port}.{name}") for name in COUNTS}
        # In every cycle of the adapter, not of each message: between two it grows.
        ages = distribution(ages_s[ages_s >= 0.0] * 1e3)
        imports.append({"entry": f"{BOARD}.{port}", "source": source, **counts, "age_ms": ages})
    exports = [
        {"entry": f"{BOARD}.{port}", "source": source, "sent": last(f"export_{port}.sent")}
        for port, source in entries.exports.items()
    ]
    return {
        "imports": imports,
        "exports": exports,
        "peers": [_peer(recording, rack) for rack in entries.peers],
    }


def _peer(recording: Recording, rack: str) -> Report:
    mailbox = f"{BOARD}.{peer_port(rack)}"
    presence = recording.signal(mailbox, "presence")
    cycle_s = recording.layout.task(BOARD).every * recording.layout.clock_ns * 1e-9
    launches = int(recording.signal(mailbox, "launches")[-1])
    return {
        "peer": rack,
        "state": Presence(int(presence[-1])).name.lower(),
        "losses": int(recording.signal(mailbox, "losses")[-1]),
        "restarts": max(0, launches - 1),
        "lost_s": round(float((presence == Presence.LOST).sum() * cycle_s), 6),
    }
