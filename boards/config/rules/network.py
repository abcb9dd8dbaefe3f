"""Mistakes in `[adapter.lan]` that concern security: endpoints without TLS, and credentials that cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from rack.boards.config.schema import RackConfig
from rack.boards.errors import Mistake
from rack.boards.lan.config import LanTable
from rack.boards.lan.credentials import Credentials
from rack.boards.lan.endpoint import Endpoint

PLACE = "adapter.lan"
SOON = timedelta(days=30)
"""Time before the end of certificates from which a launch warns."""


def network_mistakes(config: RackConfig) -> Iterator[Mistake]:
    """Yield what is wrong with the endpoints, judged by the config alone."""
    table = config.adapter.lan
    if table is None:
        return
    for key, endpoint in table.endpoints:
        if why := _why_not(endpoint, table, connects=key.startswith("connect")):
            yield Mistake(f"{PLACE}.{key}", str(endpoint), why)
    if table.has_tls and table.certificates is None:
        yield Mistake(f"{PLACE}.certificates", None, "missing; TLS needs them: see rack lan certificates --help")
    if table.has_tls and table.exports and not table.racks:
        yield Mistake(f"{PLACE}.peers", None, "missing; with TLS only racks that it names may import from this one")


def _why_not(endpoint: Endpoint, table: LanTable, connects: bool) -> str:
    if endpoint.has_tls and connects and ":" in endpoint.host:
        return "zenoh checks no certificate for an address of IPv6; permitted: a host name, or an address of IPv4"
    if not endpoint.has_tls and table.has_tls:
        return "without TLS, which others have: who comes here is not known; permitted: all with TLS, or none"
    if not endpoint.has_tls and not endpoint.is_loopback and not table.insecure:
        return (
            "beyond this machine without TLS; permitted: tls/ or quic/ with certificates, an address of loopback, or "
            f"by name, {PLACE}.insecure = true"
        )
    return ""


def credential_mistakes(config: RackConfig) -> Iterator[Mistake]:
    """Yield what is wrong with the files of the credentials on this machine, now."""
    table = config.adapter.lan
    if table is None or table.certificates is None:
        return
    heard = [Endpoint.of(text) for text in table.listen]
    addresses = dict.fromkeys(e.host for e in heard if e.has_tls and not e.is_everywhere)
    for flaw in Credentials(Path(table.certificates), config.name).flaws(addresses):
        # The file first: a long path is cut short.
        yield Mistake(f"{PLACE}.certificates", None, f"{flaw.path.name}: {flaw.why}; in {table.certificates}")


def network_notes(config: RackConfig) -> list[str]:
    """Return what a launch says of the network: endpoints without TLS that others can reach, certificates that end."""
    table = config.adapter.lan
    if table is None:
        return []
    far = [str(endpoint) for _, endpoint in table.endpoints if not (endpoint.has_tls or endpoint.is_loopback)]
    may = "read and forge" if table.certificates is None else "read"
    notes = [f"without TLS: whoever reaches {', '.join(far)} may {may} what is exchanged"] if far else []
    if table.certificates is not None and table.has_tls:
        expires = Credentials(Path(table.certificates), config.name).expires
        if expires - datetime.now(UTC) < SOON:
            notes.append(f"certificates expire on {expires:%Y-%m-%d %H:%M} UTC: the other racks are lost then")
    return notes
