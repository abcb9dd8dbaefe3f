"""Addresses of racks on other machines, and the identity of an operator."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from rack.backplane.rack_name import RACK_NAME
from rack.tools.console.answer import Failure

PORT = 7447
"""Default port of a rack's network adapter."""
OPERATOR = "operator"
"""Default name of an operator."""
_ADDRESS = re.compile(rf"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(?::([0-9]{{1,5}}))?/({RACK_NAME})")


class Operator(NamedTuple):
    """Identity of the person who sets an emergency stop.

    Attributes:
        name: Name as in `adapter.lan.estop_from`.
        certificates: Folder with the operator's certificates. Empty for none.
    """

    name: str = OPERATOR
    certificates: str = ""

    @classmethod
    def from_options(cls, name: str, certificates: str) -> Operator:
        """Check the options of a command and return the operator.

        Args:
            name: Value of --as.
            certificates: Value of --certificates.

        Raises:
            Failure: The name is invalid, or the folder does not exist.
        """
        if re.fullmatch(RACK_NAME, name) is None:
            raise Failure(
                f'--as = "{name}": must be at most 40 small letters, digits, "-" and "_"',
                2,
            )
        if certificates and not Path(certificates).is_dir():
            raise Failure(f"--certificates = {certificates}: not a folder", 2)
        return cls(name, certificates)


class RackAddress(NamedTuple):
    """Address of a rack on another machine: host, port and name.

    An IPv6 address as host includes its brackets.
    """

    host: str
    port: int
    rack: str

    @classmethod
    def parse_address(cls, text: str) -> RackAddress:
        """Parse HOST[:PORT]/RACK. Raises `Failure`."""
        match = _ADDRESS.fullmatch(text)
        if match is None or not 0 < int(match[2] or PORT) < 1 << 16:
            raise Failure(
                f'RACK = "{text}": must be RACK or HOST[:PORT]/RACK, as in 10.0.0.5/cell',
                2,
            )
        return cls(match[1], int(match[2] or PORT), match[3])

    @property
    def endpoint(self) -> str:
        """Host and port as users type them, without the port if it is the default."""
        return self.host if self.port == PORT else f"{self.host}:{self.port}"

    def __str__(self) -> str:
        return f"{self.endpoint}/{self.rack}"
