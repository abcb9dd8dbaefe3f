"""An end on the link of a rack's network adapter, with its envelopes, its seals and its access
control."""

from __future__ import annotations

from collections.abc import Iterator

import zenoh

from rack.boards.lan.config import LanTable
from rack.boards.lan.envelope import Envelope, Flaw
from rack.boards.lan.keys import ALL_ALIVE, out_key
from rack.boards.lan.link import Arrived, LanLink
from rack.tools.lab.benches.lan_ends import (
    COORDINATOR,
    LEASE_MS,
    PORT,
    UNREAD,
    LanTask,
    Notice,
    Take,
    rack_name,
)


class RackEnd:
    """The link of a rack's network adapter, with its envelopes and seals."""

    def __init__(self, task: LanTask, notice: Notice, take: Take | None) -> None:
        self._link = link = LanLink(rack_name(task.machine), _table(task))
        self._number = 0
        keys = {other: _key(task.machine, other) for other in task.others}
        self._puts = {other: (key, link.publish(key)) for other, key in keys.items()}
        self._from = {_key(other, task.machine): other for other in task.others}
        self._arrived = [link.subscribe(key, UNREAD) for key in self._from if take is None]
        if take is not None:
            for key in self._from:
                link.on(key, lambda arrived: take(*self._opened(arrived)))
        racks = {rack_name(other): other for other in task.others}

        def see(sample: zenoh.Sample) -> None:
            rack = str(sample.key_expr).split("/")[1]
            if rack in racks:
                notice(racks[rack], sample.kind == zenoh.SampleKind.PUT)

        self._alive = link.session.liveliness().declare_subscriber(ALL_ALIVE, see, history=True)
        link.declare_alive(task.machine)

    def _opened(self, arrived: Arrived) -> tuple[int, bytes]:
        head = self._link.sealer.opened(arrived.key, arrived.envelope, arrived.payload)
        if isinstance(head, Flaw):
            raise RuntimeError(f"{arrived.key}: {head.name.lower()}")
        return self._from[arrived.key], arrived.payload

    def send(self, to: int, content: bytes) -> None:
        """Seal and send a message to a machine."""
        self._number += 1
        key, put = self._puts[to]
        put(
            content,
            self._link.sealer.seal(
                key, Envelope(0, 0, self._number, self._number, 0, 0, 0), content
            ),
        )

    def taken(self) -> Iterator[tuple[int, bytes]]:
        """Yield what has come since the last call."""
        for arrived in self._arrived:
            yield from map(self._opened, arrived())


def _mailbox(reader: int) -> str:
    return f"task.for_{rack_name(reader)}"


def _key(writer: int, reader: int) -> str:
    return out_key(rack_name(writer), _mailbox(reader))


def _table(task: LanTask) -> LanTable:
    """Return what would stand in the config of this rack."""
    others = {rack_name(other): other for other in task.others}
    imported = {
        name: {"from": f"{name}/{_mailbox(task.machine)}", "type": "none:NONE", "max_age_ms": 1000}
        for name in others
    }
    transport = "tls" if task.certificates else "tcp"
    way = "listen" if task.is_coordinator else "connect"
    table = {
        way: [f"{transport}/{task.addresses[COORDINATOR]}:{PORT}"],
        "lease_ms": LEASE_MS,
        "insecure": not task.certificates,
        "certificates": task.certificates or None,
        "export": {name: {"from": _mailbox(other)} for name, other in others.items()},
        "import": imported,
    }
    return LanTable.model_validate(table)
