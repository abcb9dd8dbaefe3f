"""Racks on other machines as users name them, and operators as those racks know them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from rack.backplane.rack_name import RACK_NAME
from rack.tools.console.answer import Failure

PORT = 7447
OPERATOR = "operator"
_ADDRESS = re.compile(rf"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(?::([0-9]{{1,5}}))?/({RACK_NAME})")


class Operator(NamedTuple):
    """Who sets an emergency stop: a name as in `adapter.lan.estop_from`, and the folder with its
    certificates; empty: none.
    """

    name: str = OPERATOR
    certificates: str = ""

    @classmethod
    def of(cls, name: str, certificates: str) -> Operator:
        """Return the operator by the options of a command. Raises `Failure`."""
        if re.fullmatch(RACK_NAME, name) is None:
            raise Failure(
                f'--as = "{name}": not a name; permitted: small letters, digits, "-" and "_", at'
                " most 40",
                2,
            )
        if certificates and not Path(certificates).is_dir():
            raise Failure(f"--certificates = {certificates}: not a folder", 2)
        return cls(name, certificates)


class RackAddress(NamedTuple):
    """A rack on another machine: the host and port at which it listens, and its name. An IPv6
    address has its brackets.
    """

    host: str
    port: int
    rack: str

    @classmethod
    def of(cls, text: str) -> RackAddress:
        """Return the address in HOST[:PORT]/RACK. Raises `Failure`."""
        found = _ADDRESS.fullmatch(text)
        if found is None or not 0 < int(found[2] or PORT) < 1 << 16:
            raise Failure(
                f'RACK = "{text}": not a rack; permitted: RACK, or HOST[:PORT]/RACK, as in'
                " 10.0.0.5/cell",
                2,
            )
        return cls(found[1], int(found[2] or PORT), found[3])

    @property
    def at(self) -> str:
        """Host and port as users write them."""
        return self.host if self.port == PORT else f"{self.host}:{self.port}"

    def __str__(self) -> str:
        return f"{self.at}/{self.rack}"
