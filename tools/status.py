"""`rack status`: one look at a running rack."""

from __future__ import annotations

from typing import Annotated

import typer

from rack.tools.answer import Failure, Json, named, print_json


def status(
    rack: Annotated[
        str | None,
        typer.Argument(metavar="[RACK]", help="running rack by name; not needed when only one runs", callback=named),
    ] = None,
    as_json: Json = False,
) -> None:
    """Show every task of a running rack once.

    State, cycles, misses, times, how far the work is, and what holds it: since when, what for, and how to release it.

    Exit status: 0 it was shown, 1 there is no such rack, 2 RACK is missing and several racks run.

    \b
    Examples:
      rack status
      rack status nasrem --json
    """
    from dataclasses import asdict

    from rack.backplane.segment import Segment, racks
    from rack.tools.live_table import console, table_of
    from rack.tools.snapshot import Viewer

    running = racks()
    if rack is None and len(running) != 1:
        names = ", ".join(running)
        raise Failure(f"RACK is missing; racks: {names}", 2) if running else Failure("no rack is running")
    found = Viewer(Segment.attach(rack or running[0])).look()
    if as_json:
        print_json(asdict(found))
        return
    console().print(table_of(found))
