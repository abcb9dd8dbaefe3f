"""`rack status`: one look at a running rack."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from rack.backplane.segment import Segment, racks
from rack.tools.console.answer import Failure, Json, named, print_json, rack_names
from rack.tools.console.tables import console
from rack.tools.runs.display import RackView
from rack.tools.runs.snapshot import RackMonitor

OnlyRack = Annotated[
    str | None,
    typer.Argument(
        metavar="RACK",
        help="running rack by name; not needed when only one is running",
        autocompletion=rack_names,
        callback=named,
    ),
]


def status(rack: OnlyRack = None, as_json: Json = False) -> None:
    """Show a running rack once: every task, its faults, what holds it, and its progress.

    Each task has a line with its cycles, misses, longest times and state. A hold is shown with its time, its reason,
    and the command that releases it.

    Exit status: 0 it was shown; 1 there is no such rack; 2 RACK is missing and several racks are running.

    \b
    Examples:
      rack status
      rack status nasrem --json
    """
    running = racks()
    if rack is None and len(running) != 1:
        names = ", ".join(running)
        raise Failure(f"RACK is missing; racks: {names}", 2) if running else Failure("no rack is running")
    found = RackMonitor(Segment.attach(rack or running[0])).look()
    print_json(asdict(found)) if as_json else console().print(RackView(found))
