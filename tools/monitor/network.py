"""Describes a running rack's exchange with other racks over the network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

from rack.backplane.bounded_toml import load_toml
from rack.levels.peer import Presence, format_peer_port
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


@dataclass(frozen=True)
class PeerRow:
    """Current state of another rack.

    Attributes:
        clock_ms: Its clock minus the clock of this rack. None if unknown, or in lockstep.
        within_ms: Uncertainty of `clock_ms`.
    """

    peer: str
    state: str
    since_tick: int
    launches: int
    losses: int
    clock_ms: float | None
    within_ms: float | None


@dataclass(frozen=True)
class ImportRow:
    """Current state of an import, with its counts.

    Attributes:
        age_ticks: Age of its information in ticks of this rack. None before the first message.
        age_s: The same age in s of simulated time.
    """

    entry: str
    source: str
    taken: int
    missing: int
    disordered: int
    repeated: int
    late: int
    refused: int
    unknown_launch: int
    superseded: int
    age_ticks: int | None
    age_s: float | None


@dataclass(frozen=True)
class ExportRow:
    """Current state of an export."""

    entry: str
    source: str
    sent: int


class ExchangedEntries(NamedTuple):
    """Exports and imports of a rack, as dictionaries from port to source, and its partner racks."""

    exports: dict[str, str]
    imports: dict[str, str]
    peers: tuple[str, ...]


@cache
def read_entries(config: str) -> ExchangedEntries:
    """Read the exports, imports and partner racks from a config, given as TOML text.

    All are empty for a rack without a network adapter.
    """
    table: dict[str, Any] = load_toml(config).get("adapter", {}).get(ADAPTER, {})
    exports, imports = (
        {port: entry["from"] for port, entry in table.get(key, {}).items()}
        for key in ("export", "import")
    )
    racks = [*(source.partition("/")[0] for source in imports.values()), *table.get("peers", ())]
    return ExchangedEntries(exports, imports, tuple(dict.fromkeys(racks)))


def list_peers(newest: NewestMessages) -> Iterator[PeerRow]:
    """Yield the state of each partner rack that the network adapter has reported."""
    for rack in read_entries(newest.segment.config).peers:
        peer: Any = newest.read_message(f"{ADAPTER}.{format_peer_port(rack)}")
        if peer is not None:
            is_known = peer.uncertainty > 0.0
            clock = (peer.offset * 1e3, peer.uncertainty * 1e3) if is_known else (None, None)
            state = Presence(peer.presence).name.lower()
            yield PeerRow(rack, state, peer.since, peer.launches, peer.losses, *clock)


def list_imports(newest: NewestMessages) -> Iterator[ImportRow]:
    """Yield the state of each import of a rack."""
    imports = read_entries(newest.segment.config).imports
    for port, source, counts in _list_counts(newest, "import", imports):
        age = int(counts["age"])
        ages = (None, None) if age < 0 else (age, float(counts["age_s"]))
        numbers = {name: int(counts[name]) for name in COUNTS}
        entry = f"{ADAPTER}.{port}"
        yield ImportRow(entry, source, **numbers, age_ticks=ages[0], age_s=ages[1])


def list_exports(newest: NewestMessages) -> Iterator[ExportRow]:
    """Yield the state of each export of a rack."""
    exports = read_entries(newest.segment.config).exports
    for port, source, counts in _list_counts(newest, "export", exports):
        yield ExportRow(f"{ADAPTER}.{port}", source, int(counts["sent"]))


def _list_counts(
    newest: NewestMessages, kind: str, sources: Mapping[str, str]
) -> Iterator[tuple[str, str, Any]]:
    """Yield port, source and counts of each import or export.

    Yields nothing until the adapter has reported its first counts.

    Args:
        newest: Reads the status of the adapter.
        kind: "import" or "export".
        sources: Dictionary from port to source.
    """
    if (status := newest.read_message(STATUS)) is not None:
        for port, source in sources.items():
            yield port, source, getattr(status, f"{kind}_{port}")
