"""Endpoints: where a session listens, or connects to."""

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
PERMITTED = (
    "permitted: tcp/, tls/ or quic/, an address or a host name, and a port from 1 to 65535; or"
    " unix/ and a name"
)


class Endpoint(NamedTuple):
    """An endpoint; `host` is a name, or an address without brackets; of a Unix socket, its own
    name.
    """

    protocol: str
    host: str
    port: int

    @classmethod
    def of(cls, text: str) -> Endpoint:
        """Return the endpoint in a text. Raises `ValueError`: it is malformed."""
        if (own := _OWN.fullmatch(text)) is not None:
            return cls(UNIX, own[1], 0)
        found = _SHAPE.fullmatch(text)
        if found is None or not 0 < int(found[3]) <= 65535:
            raise ValueError(PERMITTED)
        host = found[2].strip("[]")
        # What looks like an address must be one: resolvers take 127.1 and 300 for addresses too.
        if ":" in host or _NUMBERS.fullmatch(host):
            try:
                ip_address(host)
            except ValueError:
                raise ValueError(f"'{host}' is no address; {PERMITTED}") from None
        return cls(found[1], host, int(found[3]))

    def __str__(self) -> str:
        """Return it as a text."""
        if self.is_private:
            return f"{UNIX}/{self.host}"
        return f"{self.protocol}/{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"

    @property
    def has_tls(self) -> bool:
        """Whether both sides show certificates."""
        return self.protocol in TLS

    @property
    def is_private(self) -> bool:
        """Whether only this user's processes can reach it."""
        return self.protocol == UNIX

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach it."""
        with suppress(ValueError):
            return ip_address(self.host).is_loopback
        return self.host == "localhost"

    @property
    def is_everywhere(self) -> bool:
        """Whether it stands for all addresses of the machine."""
        with suppress(ValueError):
            return ip_address(self.host).is_unspecified
        return False


def endpoints_of(table: LanTable) -> list[Endpoint]:
    """Return the endpoints of a table; malformed ones are mistakes that are reported elsewhere."""
    found = []
    for text in (*table.listen, *table.connect):
        with suppress(ValueError):
            found.append(Endpoint.of(text))
    return found


def has_tls(table: LanTable) -> bool:
    """Return True if the others are known by their certificates."""
    return any(endpoint.has_tls for endpoint in endpoints_of(table))
