"""`rack record`: attach a recorder to a running rack."""

from __future__ import annotations

import sys
from contextlib import closing, suppress
from pathlib import Path
from shutil import copyfile
from threading import Event

from rack.backplane.segment import Segment
from rack.boards.config.layout import RETAINED_S
from rack.tools.commands.replay import merge_runs
from rack.tools.console.answer import Document, Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName, View, option
from rack.tools.launch.folder import choose_run_folder
from rack.tools.recording.checksums import CHECKSUMS
from rack.tools.recording.current_run import find_run_folder
from rack.tools.recording.divergence import find_tick_range
from rack.tools.recording.file_names import CODE, CONFIG, ORIGIN, PUBLISHED, SPOOL
from rack.tools.recording.folder_size import (
    format_recorded_line,
    format_size,
    measure_size,
    measure_sizes,
)
from rack.tools.recording.recorder.process import start_recorder
from rack.tools.recording.recording import Recording
from rack.tools.recording.run_files import EVENTS, rebuild_files
from rack.tools.recording.spool import STRETCHES, list_stretch_files
from rack.tools.viewer.parts import FILE
from rack.tools.viewer.window import ViewerWindow, find_free_port, format_url

CHECK_INTERVAL_S = 0.1
"""Time between two checks of the racks and their recorders."""


def record(
    rack: RackName,
    out: Path | None = option("--out DIR", "folder of the recording; default: runs/<rack>-<time>"),
    view: View = False,
    save: bool = option(
        "--save", "save the recording of its run so far, without touching the run", False
    ),
    as_json: Json = False,
) -> None:
    """Record a running rack until its run is over, or until Ctrl-C.

    The recording begins with the last two seconds, which are still in the rack's rings. `rack
    report`, `rack analyze` and `rack replay` read it. Recording causes no missed deadlines, and the
    run continues when it ends.

    Racks that work together are recorded by a command each, on their machines. `rack replay` joins
    the folders on one time line.

    --save copies what the recorder of `rack run` has recorded so far into a new run folder. Run and
    recording continue.

    \b
    Examples:
      rack record nasrem
      rack record nasrem --view --out runs/look
      rack record --save nasrem
    """
    if save and view:
        raise Failure("--save, --view: give one of them", 2)
    with closing(Segment.attach(rack)) as segment:
        folder = choose_run_folder(out, rack)
        if save:
            print_answer(*_save_recording(segment, folder), as_json)
            return
        clock_ns = segment.layout.clock_ns
        first_tick = max(0, segment.tick - round(RETAINED_S * 1e9 / clock_ns))
        notes = _record_run(segment, folder, view)
        lasted_s = (segment.tick - first_tick) * clock_ns * 1e-9
    for text in notes:
        print(text, file=sys.stderr)
    answer = {
        "rack": rack,
        "folder": str(folder),
        "notes": notes,
        **measure_sizes(folder, lasted_s),
    }
    print_answer(answer, format_recorded_line(folder, lasted_s), as_json)


def _save_recording(segment: Segment, folder: Path) -> tuple[Document, str]:
    """Save the recording of a running rack so far. Returns the answer as data and as a line."""
    name = segment.layout.rack
    with INTERRUPT.raise_interrupted():
        copy_recording(segment, folder, "--save ")
        recording = Recording(folder)
        if not recording.cycles:
            raise Failure(f"--save {name}: nothing is recorded yet")
        merge_runs([folder], folder / FILE)
    tick_s = segment.layout.clock_ns * 1e-9
    first, end = find_tick_range(recording)
    since_s, until_s = first * tick_s, (end - 1) * tick_s
    size = measure_size(folder)
    size_note = format_size(size, until_s - since_s)
    summary = f"saved into {folder}: {since_s:.2f} s to {until_s:.2f} s, {size_note}"
    times = {"since_s": since_s, "until_s": until_s}
    return {"rack": name, "folder": str(folder), **times, "bytes": size}, summary


def copy_recording(segment: Segment, into: Path, asked: str = "") -> None:
    """Copy the recording of a running rack so far to a new run folder.

    Args:
        segment: The rack.
        into: The new folder.
        asked: Prefix of the text of the `Failure`.

    Raises:
        Failure: The rack is not recorded.
    """
    name = segment.layout.rack
    run = find_run_folder(segment)
    if run is None:
        why = f"the rack is not recorded; 'rack record {name}' records it"
        raise Failure(f"{asked}{name}: {why}")
    save_run(run, into)


def save_run(folder: Path, into: Path) -> None:
    """Copy an unfinished recording from `folder` to the run folder `into`, while it continues."""
    stretches = (f"{STRETCHES}/{path.name}" for path in list_stretch_files(folder))
    for name in (CONFIG, PUBLISHED, ORIGIN, CODE, EVENTS, CHECKSUMS, SPOOL, *stretches):
        (into / name).parent.mkdir(parents=True, exist_ok=True)
        # Some files may be missing: the flight recorder removes old ones, few runs have an origin.
        with suppress(FileNotFoundError):
            copyfile(folder / name, into / name)
    rebuild_files(into)


def _record_run(segment: Segment, folder: Path, view: bool) -> list[str]:
    """Record a rack until its run is over or Ctrl-C is pressed. Returns messages for the user."""
    notes: list[str] = []
    port = find_free_port() if view else None
    ended = Event()
    # Ctrl-C ends the recording, not the run.
    with INTERRUPT.stop_orderly(ended.set):
        recorder = start_recorder(segment, folder, port)
        try:
            if port is not None:
                ViewerWindow(format_url(port))
            while not segment.run_is_over and not ended.wait(CHECK_INTERVAL_S):
                notes += recorder.read_notices()
        finally:
            recorder.finish(in_a_hurry=INTERRUPT.number != 0)
        return [*notes, *recorder.read_notices()]
