"""How a command answers: text for people, or one JSON document, and an exit status."""

from __future__ import annotations

import json
import sys
from typing import Annotated, Any, NoReturn

import typer

from rack.boards.errors import one_line

LONGEST_LINE = 1300
"""Characters of one line of a refusal, at most."""


def configs(start: str) -> list[str]:
    """Return the project's configs that begin so, for a shell to complete."""
    from rack.boards.config import names

    return [name for name in names() if name.startswith(start)]


def running(start: str) -> list[str]:
    """Return the racks in shared memory that begin so, for a shell to complete."""
    from rack.backplane.segment import racks

    return [name for name in racks() if name.startswith(start)]


Json = Annotated[bool, typer.Option("--json", help="print one JSON document on stdout, and nothing else")]
ConfigName = Annotated[
    str, typer.Argument(metavar="CONFIG", help="config by name, or a path to a .toml file", autocompletion=configs)
]


def named(rack: str | None) -> str | None:
    """Return the name of a rack. Raises `Failure` for one that no rack can have."""
    if rack == "":
        raise Failure('RACK = "": empty; permitted: a running rack by name, as "rack list" shows it', 2)
    return rack


RackName = Annotated[
    str,
    typer.Argument(
        metavar="RACK", help="running rack by name, as 'rack list' shows it", autocompletion=running, callback=named
    ),
]
Settings = Annotated[
    list[str], typer.Option("--set", metavar="KEY=VALUE", help="override one value, as in clock.speed=2; repeatable")
]

Faults = Annotated[
    str | None, typer.Option(metavar="FILE", help="fault script, by name or path; added to the config's own faults")
]


class Failure(Exception):
    """A command that did not work, for a reason that is one line for the user; `status` is the exit status."""

    def __init__(self, reason: str, status: int = 1) -> None:
        super().__init__(reason)
        self.status = status


def print_json(document: Any) -> None:
    """Print the answer of a command that was asked for JSON."""
    print(json.dumps(document, indent=2))


def fail(reason: str, status: int) -> NoReturn:
    """End the command: the reason on stderr, on stdout too, as JSON, when that was asked for."""
    lines = [
        line if line.isprintable() and len(line) <= LONGEST_LINE else one_line(line, LONGEST_LINE)
        for line in reason.splitlines()
    ]
    print(*lines, sep="\n", file=sys.stderr)
    if "--json" in sys.argv[1:]:
        print_json({"error": lines})
    sys.exit(status)
