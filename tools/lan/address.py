"""Racks on other machines as users name them, and users as those racks know them."""

from __future__ import annotations

import re
from typing import NamedTuple

from rack.tools.console.answer import Failure

PORT = 7447
OPERATOR = "operator"
CERTIFICATES = "RACK_CERTIFICATES"
"""Environment variable with the default of --certificates."""
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,39}")
_HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(?::([0-9]{1,5}))?")


class Asker(NamedTuple):
    """Who asks: a name as in `[adapter.lan.permit]`, and the folder with its certificates; empty: none."""

    name: str = OPERATOR
    certificates: str = ""


class HostAddress(NamedTuple):
    """A machine, or a port of it, at which a rack listens. An IPv6 address has its brackets."""

    host: str
    port: int = PORT

    @classmethod
    def of(cls, text: str) -> HostAddress:
        """Return the address in a text. Raises `Failure`."""
        found = _HOST.fullmatch(text)
        if found is None or not 0 < int(found[2] or PORT) < 1 << 16:
            raise Failure(f'HOST = "{text}": not a host; permitted: a name or address, as in 10.0.0.5 or cell:7447', 2)
        return cls(found[1], int(found[2] or PORT))

    def __str__(self) -> str:
        return self.host if self.port == PORT else f"{self.host}:{self.port}"


class RackAddress(NamedTuple):
    """A rack on another machine."""

    at: HostAddress
    rack: str

    @classmethod
    def of(cls, text: str) -> RackAddress:
        """Return the address in HOST[:PORT]/RACK. Raises `Failure`."""
        host, _, rack = text.partition("/")
        if _NAME.fullmatch(rack) is None:
            raise Failure(f'RACK = "{text}": not a rack; permitted: RACK, or HOST/RACK, as in 10.0.0.5/cell', 2)
        return cls(HostAddress.of(host), rack)

    def __str__(self) -> str:
        return f"{self.at}/{self.rack}"
