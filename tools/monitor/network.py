"""Describes a running rack's exchange with other racks over the network."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

from rack.backplane.bounded_toml import load_toml
from rack.backplane.segment import Segment
from rack.levels.peer import Presence, format_peer_port
from rack.tools.console.answer import Document
from rack.tools.monitor.newest_messages import NewestMessages

ADAPTER = "lan"
STATUS = f"{ADAPTER}.status"
COUNTS = (
    "taken",
    "missing",
    "disordered",
    "repeated",
    "late",
    "refused",
    "unknown_launch",
    "superseded",
)
"""Names of the counts of an import: see `rack.boards.lan.adapter.IMPORT`."""


class ExchangedEntries(NamedTuple):
    """Exports and imports of a rack, as dictionaries from port to source, and its partner racks."""

    exports: dict[str, str]
    imports: dict[str, str]
    peers: tuple[str, ...]


@cache
def read_entries(config: str) -> ExchangedEntries | None:
    """Read the exports, imports and partner racks from a config, given as TOML text.

    Returns None for a rack without a network adapter.
    """
    table: dict[str, Any] | None = load_toml(config).get("adapter", {}).get(ADAPTER)
    if table is None:
        return None
    exports, imports = (
        {port: entry["from"] for port, entry in table.get(key, {}).items()}
        for key in ("export", "import")
    )
    racks = [*(source.partition("/")[0] for source in imports.values()), *table.get("peers", ())]
    return ExchangedEntries(exports, imports, tuple(dict.fromkeys(racks)))


def _find_entries(segment: Segment) -> ExchangedEntries:
    """Return the exports, imports and partners of a rack. Empty without a network adapter."""
    has_adapter = any(task.name == ADAPTER for task in segment.layout.tasks)
    return (read_entries(segment.config) if has_adapter else None) or ExchangedEntries({}, {}, ())


def list_peers(newest: NewestMessages) -> list[Document]:
    """Return the state of each partner rack that the network adapter has reported.

    `clock_ms` is its clock minus the clock of this rack, and `within_ms` the uncertainty. Both are
    None if unknown, or in lockstep.
    """
    rows = []
    for rack in _find_entries(newest.segment).peers:
        message: Any = newest.read_message(f"{ADAPTER}.{format_peer_port(rack)}")
        if message is not None:
            is_known = message.uncertainty > 0.0
            rows.append(
                {
                    "peer": rack,
                    "state": Presence(message.presence).name.lower(),
                    "since_tick": message.since,
                    "launches": message.launches,
                    "losses": message.losses,
                    "clock_ms": message.offset * 1e3 if is_known else None,
                    "within_ms": message.uncertainty * 1e3 if is_known else None,
                }
            )
    return rows


def list_imports(newest: NewestMessages) -> list[Document]:
    """Return the counts of each import of a rack, and the age of its information.

    The age is given in ticks of this rack, and in s of simulated time. None before the first
    message.
    """
    rows = []
    for row, counts in _list_counts(newest, "import"):
        numbers = {name: int(counts[name]) for name in COUNTS}
        age = int(counts["age"])
        ages = (None, None) if age < 0 else (age, float(counts["age_s"]))
        rows.append({**row, **numbers, "age_ticks": ages[0], "age_s": ages[1]})
    return rows


def list_exports(newest: NewestMessages) -> list[Document]:
    """Return the number of messages that each export of a rack has sent."""
    return [{**row, "sent": int(counts["sent"])} for row, counts in _list_counts(newest, "export")]


def _list_counts(newest: NewestMessages, kind: str) -> Iterator[tuple[Document, Any]]:
    """Yield name and source of each import or export, and its counts.

    Yields nothing until the adapter has reported its first counts.

    Args:
        newest: Reads the status of the adapter.
        kind: "import" or "export".
    """
    if (status := newest.read_message(STATUS)) is not None:
        sources = getattr(_find_entries(newest.segment), f"{kind}s")
        for port, source in sources.items():
            row = {"entry": f"{ADAPTER}.{port}", "source": source}
            yield row, getattr(status, f"{kind}_{port}")
