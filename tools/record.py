"""`rack record`: attach a recorder to a running rack, or to several that work together."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from rack.backplane.segment import Segment
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName, View
from rack.tools.recorder.recorder import Recorder, SafeSink
from rack.tools.replay import merge
from rack.tools.runs.folder import folder_of
from rack.tools.runs.window import ViewerWindow, free_port, url
from rack.tools.viewer.sink import FILE, ViewSink

MERGE_S = 60.0
"""Time to put recordings on one time line after Ctrl-C; a second one ends it at once."""
Out = Annotated[Path | None, typer.Option(metavar="DIR", help="folder of the recording; default: runs/<rack>-<time>")]
With = Annotated[
    list[str], typer.Option("--with", metavar="RACK", help="record this rack as well, on one time line; repeatable")
]


def record(
    rack: RackName,
    others: With = [],  # noqa: B006  typer copies it
    out: Out = None,
    view: View = False,
    as_json: Json = False,
) -> None:
    """Record a running rack until its run is over, or until Ctrl-C.

    The recording begins with the two seconds that the rack's rings still hold. `rack report`, `rack analyze` and `rack
    replay` read it. Recording costs the rack no deadline, and ending it does not end the run.

    With others that it works with, each is recorded into its own folder DIR/<rack>. When the runs of all are over,
    DIR/run.rrd shows them on one time line, that of the first.

    \b
    Examples:
      rack record nasrem
      rack record nasrem --view --out runs/look
      rack record cell-puma --with cell-k1607 --with cell
    """
    racks = [rack, *others]
    if others and view:
        raise Failure("--view, --with: give one of them: the racks have a common time line only in the end", 2)
    if twice := [name for at, name in enumerate(racks) if name in racks[:at]]:
        raise Failure(f"--with {twice[0]}: given twice", 2)
    segments = [Segment.attach(name) for name in racks]
    folder = folder_of(out, rack)
    notes = _record_together(segments, folder) if others else _record(segments[0], folder, view)
    for text in notes:
        print(text, file=sys.stderr)
    print_answer({"rack": rack, "folder": str(folder), "notes": notes}, f"recorded into {folder}", as_json)


def _begin(segment: Segment, folder: Path, notes: list[str], port: int | None = None) -> Recorder:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.toml").write_text(segment.config)
    return Recorder(segment, folder, SafeSink(lambda: ViewSink(segment, folder, port), notes.append))


def _record(segment: Segment, folder: Path, view: bool) -> list[str]:
    notes: list[str] = []
    port = free_port() if view else None
    # Ctrl-C ends the recording, not the run; leaving the context finishes the files.
    with INTERRUPT.orderly(), _begin(segment, folder, notes, port) as recorder, INTERRUPT.orderly(recorder.stop):
        if port is not None:
            ViewerWindow(url(port))
        recorder.follow()
    return notes


def _record_together(segments: Sequence[Segment], folder: Path) -> list[str]:
    notes: list[str] = []
    folders = [folder / segment.layout.rack for segment in segments]
    unfinished = f"{folder / FILE} is missing: rack replay {' '.join(map(str, folders))}"
    with INTERRUPT.orderly(unfinished=unfinished, bound_s=MERGE_S):
        with ExitStack() as stack:
            recorders = [
                stack.enter_context(_begin(segment, into, notes))
                for segment, into in zip(segments, folders, strict=True)
            ]

            def stop() -> None:
                for recorder in recorders:
                    recorder.stop()

            stack.enter_context(INTERRUPT.orderly(stop, unfinished, MERGE_S))

            def follow(recorder: Recorder) -> None:
                try:
                    recorder.follow()
                except BaseException:
                    stop()
                    raise

            # One thread each: a rack that is slow to answer, on another machine, keeps none of the others waiting.
            with ThreadPoolExecutor(len(recorders)) as pool:
                list(pool.map(follow, recorders))
        return notes + _merged(folders, folder / FILE)


def _merged(folders: Sequence[Path], file: Path) -> list[str]:
    try:
        return merge(folders, file)
    except Failure as failure:
        raise Failure(f"recorded into {', '.join(map(str, folders))}; not on one time line: {failure}") from None
