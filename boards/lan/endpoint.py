"""Endpoints at which a session listens or to which it connects."""

from __future__ import annotations

import re
from contextlib import suppress
from ipaddress import ip_address
from typing import NamedTuple

from rack.backplane.rack_name import RACK_NAME
from rack.boards.lan.config import LanTable

TLS = ("tls", "quic")
UNIX = "unix"
_SHAPE = re.compile(r"(tcp|tls|quic)/(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+):([0-9]{1,5})", re.ASCII)
_OWN = re.compile(rf"{UNIX}/({RACK_NAME})")
_NUMBERS = re.compile(r"[0-9.]*")
VALID_ENDPOINTS = (
    "it must be tcp/, tls/ or quic/ with an address or host name and a port from 1 to 65535, or"
    " unix/ with a name"
)


class Endpoint(NamedTuple):
    """Address at which a session listens or to which it connects.

    `host` is a host name, or an address without brackets. For a Unix socket it is the socket's
    name, and `port` is 0.
    """

    protocol: str
    host: str
    port: int

    @classmethod
    def from_text(cls, text: str) -> Endpoint:
        """Parse an endpoint.

        Raises:
            ValueError: The text is malformed. The message says what is valid.
        """
        if (socket := _OWN.fullmatch(text)) is not None:
            return cls(UNIX, socket[1], 0)
        match = _SHAPE.fullmatch(text)
        if match is None or not 0 < int(match[3]) <= 65535:
            raise ValueError(VALID_ENDPOINTS)
        host = match[2].strip("[]")
        # Reject incomplete addresses: resolvers would accept 127.1 or 300 as an address.
        if ":" in host or _NUMBERS.fullmatch(host):
            try:
                ip_address(host)
            except ValueError:
                raise ValueError(f"'{host}' is not an address; {VALID_ENDPOINTS}") from None
        return cls(match[1], host, int(match[3]))

    def __str__(self) -> str:
        """Return the endpoint as a config contains it."""
        if self.is_private:
            return f"{UNIX}/{self.host}"
        return f"{self.protocol}/{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"

    @property
    def has_tls(self) -> bool:
        """Whether connections use TLS, so that both sides must show certificates."""
        return self.protocol in TLS

    @property
    def is_private(self) -> bool:
        """Whether only processes of this user can connect to it."""
        return self.protocol == UNIX

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can connect to it."""
        with suppress(ValueError):
            return ip_address(self.host).is_loopback
        return self.host == "localhost"

    @property
    def is_wildcard(self) -> bool:
        """Whether the host is the wildcard for all addresses of the machine."""
        with suppress(ValueError):
            return ip_address(self.host).is_unspecified
        return False


def list_endpoints(table: LanTable) -> list[Endpoint]:
    """Return the well-formed endpoints of a table. The config checks report the others."""
    endpoints = []
    for text in (*table.listen, *table.connect):
        with suppress(ValueError):
            endpoints.append(Endpoint.from_text(text))
    return endpoints


def has_tls(table: LanTable) -> bool:
    """Return True if any endpoint uses TLS, so that certificates identify the other racks."""
    return any(endpoint.has_tls for endpoint in list_endpoints(table))
