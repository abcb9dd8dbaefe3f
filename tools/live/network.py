"""A running rack's exchange with others over the network: which are there, and what passes."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from typing import Any, NamedTuple

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.levels.peer import Presence, peer_port

BOARD = "lan"
STATUS = f"{BOARD}.status"
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
"""What is counted of an import: see `rack.boards.lan.messages.IMPORT`."""


@dataclass(frozen=True)
class PeerRow:
    """Another rack now. `clock_ms` is its clock less ours, within `within_ms`, ms; None: not known,
    or in lockstep."""

    peer: str
    state: str
    since_tick: int
    launches: int
    losses: int
    clock_ms: float | None
    within_ms: float | None


@dataclass(frozen=True)
class ImportRow:
    """One import now: its counts, and the age of its information in ticks here and in s of
    simulated time."""

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
    """One export now."""

    entry: str
    source: str
    sent: int


class Entries(NamedTuple):
    """What a rack exchanges: the source of each export and import by port, and the racks with which
    it works."""

    exports: dict[str, str]
    imports: dict[str, str]
    peers: tuple[str, ...]


def exchanged(config: str) -> Entries | None:
    """Return what a rack exchanges by its config, TOML text; None: it has no network adapter."""
    table: dict[str, Any] | None = tomllib.loads(config).get("adapter", {}).get(BOARD)
    if table is None:
        return None
    exports, imports = (
        {port: entry["from"] for port, entry in table.get(key, {}).items()}
        for key in ("export", "import")
    )
    racks = [*(source.partition("/")[0] for source in imports.values()), *table.get("peers", ())]
    return Entries(exports, imports, tuple(dict.fromkeys(racks)))


class Network:
    """The exchange of one rack, row by row; there are none in a rack without a network adapter."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        entries = (
            exchanged(segment.config)
            if any(task.name == BOARD for task in segment.layout.tasks)
            else None
        )
        self._entries = entries or Entries({}, {}, ())
        self._status = None if entries is None else open_observer(segment, STATUS)
        self._peers = {
            rack: open_observer(segment, f"{BOARD}.{peer_port(rack)}")
            for rack in self._entries.peers
        }

    def peers(self) -> tuple[PeerRow, ...]:
        """Return the other racks."""
        readings = [(rack, reader.peek()) for rack, reader in self._peers.items()]
        return tuple(_peer(rack, reading.value) for rack, reading in readings if reading.is_there)

    def imports(self) -> tuple[ImportRow, ...]:
        """Return the imports."""
        found = []
        for port, counts in self._groups("import", self._entries.imports).items():
            age = int(counts["age"])
            numbers = {name: int(counts[name]) for name in COUNTS}
            ages = (None, None) if age < 0 else (age, float(counts["age_s"]))
            found.append(
                ImportRow(
                    f"{BOARD}.{port}",
                    self._entries.imports[port],
                    **numbers,
                    age_ticks=ages[0],
                    age_s=ages[1],
                )
            )
        return tuple(found)

    def exports(self) -> tuple[ExportRow, ...]:
        """Return the exports."""
        groups = self._groups("export", self._entries.exports)
        return tuple(
            ExportRow(f"{BOARD}.{port}", self._entries.exports[port], int(counts["sent"]))
            for port, counts in groups.items()
        )

    def _groups(self, kind: str, ports: dict[str, str]) -> dict[str, Any]:
        if self._status is None or not (status := self._status.peek()).is_there:
            return {}
        return {port: getattr(status.value, f"{kind}_{port}") for port in ports}


def _peer(rack: str, at: Any) -> PeerRow:
    clock_ms = within_ms = None
    if at.uncertainty > 0.0:
        clock_ms = at.offset * 1e3
        within_ms = at.uncertainty * 1e3
    return PeerRow(
        peer=rack,
        state=Presence(at.presence).name.lower(),
        since_tick=at.since,
        launches=at.launches,
        losses=at.losses,
        clock_ms=clock_ms,
        within_ms=within_ms,
    )
