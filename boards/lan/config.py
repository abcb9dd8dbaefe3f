"""Tables of `[adapter.lan]`: exports, imports, other racks and the rules of access."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from rack.backplane.message import Message
from rack.backplane.rack_name import RACK_NAME
from rack.levels.references import import_reference
from rack.levels.tables import ClassName, MailboxName, Positive, RackName, Table

FASTEST_HZ = 50.0
"""Highest rate of an exchange over a network."""
MAX_CHAIN_BYTES = 8192
"""Maximum size in bytes of a rack's certificates in DER form. They are sent with every seal."""
MessageKind = type[Message]
OnPeerLoss = Literal["hold", "stop", "go on"]
PortName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,30}$")]
Remote = Annotated[
    str, StringConstraints(pattern=rf"^{RACK_NAME}/[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*$")
]
ENDPOINT_NOTE = (
    "as in tls/192.168.1.5:7447, or on one machine unix/cell: a socket that only this user reaches"
)


class CredentialError(Exception):
    """A credential file that cannot be used.

    Attributes:
        path: Path of the file.
        why: What is wrong with it.
    """

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"{path}: {why}")
        self.path = path
        self.why = why


class ExportConfig(Table):
    """`[adapter.lan.export.<port>]`: one mailbox of this rack that others may import."""

    source: MailboxName = Field(alias="from")
    """mailbox, as in task.status; others import it as RACK/task.status"""
    rate_hz: float = Field(10.0, gt=0, le=FASTEST_HZ)
    """rate of the exchange [Hz]; divides the adapter's"""


class ImportConfig(Table):
    """`[adapter.lan.import.<port>]`: a mailbox of another rack, read by levels as `lan.<port>`."""

    source: Remote = Field(alias="from")
    """rack and mailbox, as in cell/task.orders"""
    type: ClassName
    """message class of that mailbox, package.module:Class"""
    rate_hz: float = Field(10.0, gt=0, le=FASTEST_HZ)
    """rate of the exchange [Hz]; divides the adapter's"""
    max_age_ms: Positive
    """age from which a message is old and its writer counts as lost [ms]; simulated time"""
    delay_ms: Positive | None = None
    """longest time that a message may take from its export to its arrival [ms]; simulated time"""
    max_lost: int = Field(0, ge=0, le=1000)
    """messages in a row that may be lost without a longer response than the bound"""

    @property
    def rack(self) -> str:
        """Name of the rack that writes the mailbox."""
        return self.source.partition("/")[0]

    @property
    def mailbox(self) -> str:
        """Name of the mailbox in that rack."""
        return self.source.partition("/")[2]

    def find_message_class(self) -> MessageKind:
        """Import the message class.

        Raises:
            LookupError: The module or the class does not exist, or the class is not a message.
        """
        module, name = import_reference(self.type)
        message_class = getattr(module, name, None)
        if not (isinstance(message_class, type) and issubclass(message_class, Message)):
            raise LookupError(f"module '{module.__name__}' has no message class '{name}'")
        return message_class


class LanTable(Table):
    """Keys of `[adapter.lan]` that concern the network.

    The keys of its board are declared with the boards.
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
    """real time without a sign of life after which a peer counts as lost [ms]"""
    on_peer_loss: OnPeerLoss = "hold"
    """reaction to the loss of a peer; hold: levels find its mailboxes lost at once and hold until
    its next message; stop: in addition, the arm ramps to rest and brakes until the peer is back;
    go on: levels keep its last message, however old"""
    peers: tuple[RackName, ...] = ()
    """racks with which this one works, besides the ones from which it imports; they may import, and
    lockstep waits for them"""
    launch: tuple[str, ...] = ()
    """configs of racks that `rack run` also launches on this machine, each in a separate process"""
    partners: tuple[str, ...] = ()
    """configs of racks with which `rack check` and reports join this one's timing, besides those in
    launch"""
    estop_from: tuple[RackName, ...] = ()
    """names, proved by certificates, that may set the emergency stop from another machine, with
    rack estop HOST/RACK"""
    exports: dict[PortName, ExportConfig] = Field({}, alias="export")
    """mailboxes that others may import"""
    imports: dict[PortName, ImportConfig] = Field({}, alias="import")
    """mailboxes of other racks, by port"""

    @property
    def racks(self) -> tuple[str, ...]:
        """Names of the racks with which this rack works: the racks of its imports, and `peers`."""
        return tuple(dict.fromkeys([*(entry.rack for entry in self.imports.values()), *self.peers]))
