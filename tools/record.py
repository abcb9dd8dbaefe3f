"""`rack record`: attach a recorder to a rack that is running."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tools.answer import Json, RackName, print_json

Out = Annotated[Path | None, typer.Option(metavar="DIR", help="folder of the recording; default: runs/<rack>-<time>")]


def record(rack: RackName, out: Out = None, as_json: Json = False) -> None:
    """Record a running rack, from now on.

    Trace and signals, until its run is over or Ctrl-C.
    """
    from contextlib import suppress

    from backplane.segment import Segment
    from tools.folders import folder_of
    from tools.recorder.recorder import Recorder

    segment = Segment.attach(rack)
    folder = folder_of(out, rack)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.toml").write_text(segment.config)
    # Ctrl-C ends the recording, not the run; the files are finished on the way out.
    with Recorder(segment, folder) as recorder, suppress(KeyboardInterrupt):
        recorder.follow()
    print_json({"rack": rack, "folder": str(folder)}) if as_json else print(f"recorded into {folder}")
