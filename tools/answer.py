"""How a command answers: text for people, or one JSON document, and an exit status."""

from __future__ import annotations

import json
import sys
from typing import Annotated, Any, NoReturn

import typer

Json = Annotated[bool, typer.Option("--json", help="print one JSON document on stdout, and nothing else")]
ConfigName = Annotated[str, typer.Argument(metavar="CONFIG", help="config by name, or a path to a .toml file")]
RackName = Annotated[str, typer.Argument(metavar="RACK", help="running rack by name, as 'rack list' shows it")]
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
    print(reason, file=sys.stderr)
    if "--json" in sys.argv[1:]:
        print_json({"error": reason.splitlines()})
    sys.exit(status)
