"""`rack status`: one look at a running rack."""

from __future__ import annotations

from typing import Annotated

import typer

from tools.answer import Failure, Json, print_json


def status(
    rack: Annotated[str | None, typer.Argument(metavar="[RACK]", help="rack; may be left out when one runs")] = None,
    as_json: Json = False,
) -> None:
    """Show every board of a running rack.

    State, cycles, misses, times, and how far the task is.
    """
    from dataclasses import asdict

    from backplane.segment import Segment, racks
    from tools.live_table import console, table_of
    from tools.snapshot import Viewer

    running = racks()
    if rack is None and len(running) != 1:
        raise Failure(f"which rack? racks: {', '.join(running) or 'none'}", 2)
    found = Viewer(Segment.attach(rack or running[0])).look()
    if as_json:
        print_json(asdict(found))
        return
    console().print(table_of(found))
