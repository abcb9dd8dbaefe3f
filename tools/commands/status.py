"""`rack status`: show a running rack once."""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from rack.backplane.segment import Segment, list_racks
from rack.tools.console.answer import Failure, print_json
from rack.tools.console.parameters import Json, check_local_rack_name, complete_rack_name, option
from rack.tools.console.pictures import check_picture_path
from rack.tools.console.tables import create_console
from rack.tools.monitor.display import RackView
from rack.tools.monitor.snapshot import RackMonitor
from rack.tools.recording.current_run import find_run_folder
from rack.tools.recording.folder_size import format_recorded_line, measure_size

OnlyRack = Annotated[
    str | None,
    typer.Argument(
        metavar="RACK",
        help="running rack by name; not needed when only one is running",
        autocompletion=complete_rack_name,
        callback=check_local_rack_name,
    ),
]


def status(
    rack: OnlyRack = None,
    graph: Path | None = option(
        "--graph FILE", "draw function blocks and their wires, FILE.png or FILE.svg"
    ),
    as_json: Json = False,
) -> None:
    """Show a running rack once: every task, its faults, what holds it, and its progress.

    Each task has a line with its cycles, misses, longest times and state. A hold is shown with its
    time, its reason, and the command that releases it. --graph draws a picture instead: how the
    function blocks of the rack are wired at present.

    Exit status: 0 shown; 1 there is no such rack; 2 RACK is missing and several racks are running,
    or RACK has no function blocks.

    \b
    Examples:
      rack status
      rack status nasrem --json
      rack status ibm --graph wires.png
    """
    if graph is not None:
        check_picture_path("--graph", graph)
    with closing(Segment.attach(rack or find_only_rack())) as segment:
        if graph is not None:
            from rack.tools.plots.graph import build_graph, save_graph

            save_graph(build_graph(segment), graph)
            return
        snapshot = RackMonitor(segment).take_snapshot()
        run = find_run_folder(segment)
    if as_json:
        recording = None if run is None else {"folder": str(run), "bytes": measure_size(run)}
        print_json({**asdict(snapshot), "recording": recording})
        return
    create_console().print(RackView(snapshot))
    if run is not None:
        print(format_recorded_line(run, snapshot.time_s))


def find_only_rack() -> str:
    """Return the name of the only rack on this machine.

    Raises `Failure` if there is not exactly one.
    """
    running = list_racks()
    if not running:
        raise Failure("no rack is running")
    if len(running) > 1:
        raise Failure(f"RACK is missing; racks: {', '.join(running)}", 2)
    return running[0]
