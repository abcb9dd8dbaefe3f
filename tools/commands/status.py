"""`rack status`: one look at a running rack."""

from __future__ import annotations

from typing import Annotated

import typer

from rack.tools.commands.answers import show_status
from rack.tools.console.parameters import Json, named_here, rack_names

OnlyRack = Annotated[
    str | None,
    typer.Argument(
        metavar="RACK",
        help="running rack by name; not needed when only one is running",
        autocompletion=rack_names,
        callback=named_here,
    ),
]


def status(rack: OnlyRack = None, as_json: Json = False) -> None:
    """Show a running rack once: every task, its faults, what holds it, and its progress.

    Each task has a line with its cycles, misses, longest times and state. A hold is shown with its
    time, its reason, and the command that releases it.

    Exit status: 0 it was shown; 1 there is no such rack; 2 RACK is missing and several racks are
    running.

    \b
    Examples:
      rack status
      rack status nasrem --json
    """
    show_status(rack, as_json)
