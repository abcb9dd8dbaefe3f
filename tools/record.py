"""`rack record`: attach a recorder to a running rack."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from rack.backplane.segment import Segment
from rack.tools.console.answer import print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName, View
from rack.tools.recorder.recorder import Recorder, SafeSink
from rack.tools.runs.folder import folder_of
from rack.tools.runs.window import ViewerWindow, free_port, url
from rack.tools.viewer.sink import ViewSink

Out = Annotated[Path | None, typer.Option(metavar="DIR", help="folder of the recording; default: runs/<rack>-<time>")]


def record(rack: RackName, out: Out = None, view: View = False, as_json: Json = False) -> None:
    """Record a running rack until its run is over, or until Ctrl-C.

    The recording begins with the two seconds that the rack's rings still hold. `rack report`, `rack analyze` and `rack
    replay` read it. Recording costs the rack no deadline, and ending it does not end the run.

    \b
    Examples:
      rack record nasrem
      rack record nasrem --view --out runs/look
    """
    segment = Segment.attach(rack)
    folder = folder_of(out, rack)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.toml").write_text(segment.config)
    notes: list[str] = []
    port = free_port() if view else None
    sink = SafeSink(lambda: ViewSink(segment, folder, port), notes.append)
    # Ctrl-C ends the recording, not the run; leaving the context finishes the files.
    with INTERRUPT.orderly(), Recorder(segment, folder, sink) as recorder, INTERRUPT.orderly(recorder.stop):
        if port is not None:
            ViewerWindow(url(port))
        recorder.follow()
    for text in notes:
        print(text, file=sys.stderr)
    print_answer({"rack": rack, "folder": str(folder), "notes": notes}, f"recorded into {folder}", as_json)
