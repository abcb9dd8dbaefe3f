"""Racks on other machines as users name them, and users as those racks know them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from rack.backplane.rack_name import RACK_NAME
from rack.tools.console.answer import Failure
from rack.tools.console.parameters import CERTIFICATES

PORT = 7447
OPERATOR = "operator"
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}
AT_THE_RACK = "resets an emergency stop on its own machine alone: rack estop {} --reset"
"""Why a rack refuses a reset from afar."""
_HOST = r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(?::([0-9]{1,5}))?"


class Asker(NamedTuple):
    """Who asks: a name as in `[adapter.lan.permit]`, and the folder with its certificates; empty:
    none."""

    name: str = OPERATOR
    certificates: str = ""

    @classmethod
    def default(cls) -> Asker:
        """Return who asks when nothing else is given."""
        return cls(certificates=os.environ.get(CERTIFICATES, ""))

    @classmethod
    def of(cls, name: str, certificates: str) -> Asker:
        """Return who asks by the options of a command. Raises `Failure`."""
        if re.fullmatch(RACK_NAME, name) is None:
            raise Failure(
                f'--as = "{name}": not a name; permitted: small letters, digits, "-" and "_", at'
                " most 40",
                2,
            )
        if certificates and not Path(certificates).is_dir():
            raise Failure(f"--certificates = {certificates}: not a folder", 2)
        return cls(name, certificates)


class HostAddress(NamedTuple):
    """A port of a machine at which a rack listens. An IPv6 address has its brackets."""

    host: str
    port: int = PORT

    @classmethod
    def of(cls, text: str) -> HostAddress:
        """Return the address in a text. Raises `Failure`."""
        found = re.fullmatch(_HOST, text)
        if found is None or not 0 < int(found[2] or PORT) < 1 << 16:
            raise Failure(
                f'HOST = "{text}": not a host; permitted: a name or address, as in 10.0.0.5 or'
                " cell:7447",
                2,
            )
        return cls(found[1], int(found[2] or PORT))

    @classmethod
    def of_endpoint(cls, endpoint: str) -> HostAddress:
        """Return the address of an endpoint of a config; of one that stands for all addresses, this
        machine's."""
        host, _, port = endpoint.partition("/")[2].rpartition(":")
        return cls(EVERYWHERE.get(host, host), int(port))

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
        if re.fullmatch(RACK_NAME, rack) is None:
            raise Failure(
                f'RACK = "{text}": not a rack; permitted: RACK, or HOST/RACK, as in 10.0.0.5/cell',
                2,
            )
        return cls(HostAddress.of(host), rack)

    def __str__(self) -> str:
        return f"{self.at}/{self.rack}"


@contextmanager
def needing_zenoh() -> Iterator[None]:
    """Raise `Failure` when what is imported in this context lacks the network's library."""
    try:
        yield
    except ImportError as error:
        if error.name != "zenoh":
            raise
        raise Failure(
            "racks on other machines need eclipse-zenoh: pip install nasrem-rack[lan]"
        ) from None
