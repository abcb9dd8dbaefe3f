"""`rack record`: attach a recorder to a rack that is running."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from rack.tools.answer import Json, RackName, print_json
from rack.tools.interrupt import INTERRUPT

Out = Annotated[Path | None, typer.Option(metavar="DIR", help="folder of the recording; default: runs/<rack>-<time>")]
View = Annotated[bool, typer.Option("--view", help="open the viewer on the running rack")]


def record(rack: RackName, out: Out = None, view: View = False, as_json: Json = False) -> None:
    """Record a running rack, from what its rings still hold on.

    Trace, signals and run.rrd, until its run is over or Ctrl-C.
    """
    from rack.backplane.segment import Segment
    from rack.tools.folders import folder_of
    from rack.tools.recorder.recorder import Recorder
    from rack.tools.recorder.side_sink import SideSink
    from rack.tools.viewer.sink import ViewSink
    from rack.tools.viewer.window import Window, free_port, url

    segment = Segment.attach(rack)
    folder = folder_of(out, rack)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.toml").write_text(segment.config)
    told: list[str] = []
    port = free_port() if view else None
    beside = SideSink(lambda: ViewSink(segment, folder, port), told.append)
    # Ctrl-C ends the recording, not the run; the files are finished on the way out.
    with INTERRUPT.orderly(), Recorder(segment, folder, beside) as recorder, INTERRUPT.orderly(recorder.stop):
        if port is not None:
            Window(url(port))
        recorder.follow()
    for text in told:
        print(text, file=sys.stderr)
    print_json({"rack": rack, "folder": str(folder), "told": told}) if as_json else print(f"recorded into {folder}")
