"""`[adapter.lan]`: what a rack exchanges with others over a network, with whom, and by which
rules.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from rack.backplane.message import Message
from rack.backplane.rack_name import RACK_NAME
from rack.levels.references import module_and_name
from rack.levels.tables import Positive, Table

FASTEST_HZ = 50.0
"""Fastest exchange over a network."""
MOST_CHAIN = 8192
"""Bytes of a rack's certificates in DER form, as they travel with its seals."""
MessageKind = type[Message]
OnPeerLoss = Literal["hold", "stop", "go on"]
PeerName = Annotated[str, StringConstraints(pattern=f"^{RACK_NAME}$")]
PortName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,30}$")]
Local = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*$")]
Remote = Annotated[
    str, StringConstraints(pattern=rf"^{RACK_NAME}/[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*$")
]
TypeName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$")]
ENDPOINT_NOTE = (
    "as in tls/192.168.1.5:7447, or on one machine unix/cell: a socket that only this user reaches"
)


class Credential(Exception):
    """A file of `certificates` that cannot be used: its path, and why."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"{path}: {why}")
        self.path = path
        self.why = why


class ExportConfig(Table):
    """`[adapter.lan.export.<port>]`: one mailbox of this rack that others may import."""

    source: Local = Field(alias="from")
    """mailbox, as in task.status; others import it as RACK/task.status"""
    rate_hz: float = Field(10.0, gt=0, le=FASTEST_HZ)
    """rate of the exchange [Hz]; divides the adapter's"""


class ImportConfig(Table):
    """`[adapter.lan.import.<port>]`: one mailbox of another rack, which levels here read as
    `lan.<port>`.
    """

    source: Remote = Field(alias="from")
    """rack and mailbox, as in cell/task.orders"""
    type: TypeName
    """message class of that mailbox, package.module:Class"""
    rate_hz: float = Field(10.0, gt=0, le=FASTEST_HZ)
    """rate of the exchange [Hz]; divides the adapter's"""
    max_age_ms: Positive
    """age from which a message is old and its writer counts as lost [ms]; simulated time"""

    @property
    def rack(self) -> str:
        """Name of the rack that writes it."""
        return self.source.partition("/")[0]

    @property
    def mailbox(self) -> str:
        """Name of the mailbox there."""
        return self.source.partition("/")[2]

    def message_class(self) -> MessageKind:
        """Return the message class. Raises `LookupError` with the reason if there is none."""
        module, name = module_and_name(self.type)
        found = getattr(module, name, None)
        if not (isinstance(found, type) and issubclass(found, Message)):
            raise LookupError(f"module '{module.__name__}' has no message class '{name}'")
        return found


class LanTable(Table):
    """The keys of `[adapter.lan]` that concern the network; those of its board are declared with
    the boards'.
    """

    listen: tuple[str, ...] = Field(
        (), description=f"endpoints where other racks find this one, {ENDPOINT_NOTE}"
    )
    connect: tuple[str, ...] = Field((), description=f"endpoints of other racks, {ENDPOINT_NOTE}")
    certificates: str | None = None
    """folder with this rack's certificate and key; see rack lan certificates --help"""
    insecure: bool = False
    """permit endpoints without TLS beyond loopback, or without certificates on it"""
    lease_ms: float = Field(500.0, ge=20, le=60_000)
    """real time of silence from which a peer is lost [ms]"""
    on_peer_loss: OnPeerLoss = "hold"
    """while a rack that was there is lost: hold: levels find what it writes lost at once, and hold,
    until its first message after that; stop: the same, and the arm ramps to rest, then brakes,
    until it is back; go on: levels keep its last message, however old"""
    peers: tuple[PeerName, ...] = ()
    """racks with which this one works, besides those from which it imports: they may import, and
    lockstep waits for them"""
    launch: tuple[str, ...] = ()
    """configs of racks that `rack run` launches with this one, on this machine; each in a process
    of its own"""
    estop_from: tuple[PeerName, ...] = ()
    """names, proved by certificates, that may set the emergency stop from another machine, with
    rack estop HOST/RACK"""
    most_bytes: int = Field(16_384, ge=64, le=1 << 20)
    """length of the longest message taken; bytes"""
    exports: dict[PortName, ExportConfig] = Field({}, alias="export")
    """mailboxes that others may import"""
    imports: dict[PortName, ImportConfig] = Field({}, alias="import")
    """mailboxes of other racks, by port"""

    @property
    def racks(self) -> tuple[str, ...]:
        """The racks with which this one works: those from which it imports, and `peers`."""
        return tuple(dict.fromkeys([*(entry.rack for entry in self.imports.values()), *self.peers]))
