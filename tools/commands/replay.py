"""`rack replay`: open recordings in the viewer; those of several racks on one time line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import argument, option
from rack.tools.console.progress import reading_progress
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.divergence import other_run
from rack.tools.recording.file_names import CONFIG
from rack.tools.recording.recording import Recording
from rack.tools.recording.time_line import RackPlace, on_one_time_line, side_by_side
from rack.tools.viewer.parts import FILE, parts_of
from rack.tools.viewer.window import ViewerWindow, has_screen

Places = Callable[[Sequence[Recording]], list[RackPlace]]


def replay(
    runs: list[Path] = argument(
        "RUN...", "folder of a run, as in runs/nasrem-20250101-120000; one for each rack"
    ),
    out: Path | None = option(
        "--out FILE.rrd", "make the viewer's file from what is recorded, and open nothing"
    ),
    against: Path | None = option(
        "--against RUN",
        "another run of the same rack, or 'origin', the one that RUN continues: both, tick by tick",
    ),
) -> None:
    r"""Open the recording of a run in the viewer; return when it is closed.

    It shows the arm in 3D, its curves, a Gantt lane for each task, and the log. RUN may also be a
    run.rrd.

    Of several racks that ran together, give the folder of each: they are shown at once, each under
    its name, on the time line of the first. Their clocks are compared by what the racks recorded of
    each other; how uncertain that is stands in the log. Recordings that did not run together are
    refused.

    With --against, two runs of one rack are shown at once, each under the name of its folder, on
    one time line, tick by tick: a branch, say, and the run that it branches off. The log marks
    where it branches off, and the first message that differs.

    A run without run.rrd, as of a flight recorder ([record] keep), is first made into a file.

    \b
    Examples:
      rack replay runs/nasrem-20250101-120000
      rack replay runs/cell-puma-20250101-120000 runs/cell-k1607-20250101-120001
      rack replay runs/cell-puma-* runs/cell-k1607-* --out both.rrd
      rack replay runs/slower --against runs/whole
      rack replay runs/slower --against origin
    """
    place: Places = on_one_time_line
    if against is not None:
        if len(runs) > 1:
            raise Failure("--against: permitted with one RUN", 2)
        place = side_by_side
        runs = [other_run(runs[0], against), *runs]
    if out is None and len(runs) == 1 and (recordings := _own(runs[0])):
        _show(*recordings)
        return
    parts = [part for run in runs for part in _parts(run)]
    if out is not None:
        _make(parts, out, place)
    elif len(parts) == 1 and not (parts[0] / CONFIG).exists():
        raise Failure(f"{parts[0]}: nothing to replay: it has no run.rrd", 2)
    elif has_screen():
        with INTERRUPT.raising(), TemporaryDirectory(prefix="rack-replay-") as folder:
            _make(parts, Path(folder, "run.rrd"), place)
            _show(Path(folder, "run.rrd"))
    else:
        raise Failure(
            "no screen: DISPLAY and WAYLAND_DISPLAY are not set; --out FILE.rrd saves it for one"
        )


def _own(run: Path) -> list[Path]:
    """Return the viewer's files of a run: a long one has several, as has a restarted recorder.
    Raises `Failure` for a damaged one.
    """
    is_file = run.suffix == ".rrd"
    checksums = Checksums(run.parent if is_file else run)
    found = [run] if is_file and run.is_file() else parts_of(run / FILE)
    # A recorder that was killed has left one without a checksum.
    checksums.verify(*{part.name for part in found} & {*checksums.stored})
    return found


def _parts(run: Path) -> list[Path]:
    """Return the runs in a folder that `rack record --with` has made; of any other, itself."""
    parts = (
        [] if (run / CONFIG).exists() else sorted(path.parent for path in run.glob(f"*/{CONFIG}"))
    )
    return parts or [run]


def _show(*recordings: Path) -> None:
    if problem := ViewerWindow(*(str(recording.resolve()) for recording in recordings)).wait():
        raise Failure(problem)


def _make(runs: Sequence[Path], out: Path, place: Places) -> None:
    if out.suffix != ".rrd":
        raise Failure(
            f"--out {out}: not the name of a viewer's file; permitted: a name that ends in .rrd", 2
        )
    if out.exists():
        raise Failure(f"--out {out}: exists already", 2)
    for note in merge(runs, out, place):
        print(note, file=sys.stderr)


def merge(runs: Sequence[Path], out: Path, place: Places = on_one_time_line) -> list[str]:
    """Write the viewer's file of runs that `place` puts on one time line, as those recorded
    together; return what a user should know of their times.

    Raises `Failure` if they cannot be read, or have no time in common.
    """
    for run in runs:
        if not run.is_dir():
            why = "not the folder of a run" if run.exists() else "no such folder"
            raise Failure(f"{run}: {why}", 2)
    placed = place([Recording(run) for run in runs])
    tick_s = placed[0].own.clock_ns * 1e-9
    marks = [mark for one in placed for mark in one.marks]
    notes = [f"{tick * tick_s:g} s: {text}" if tick else text for tick, text in marks]
    # It takes half a second to import.
    from rack.tools.viewer.merged import write_merged

    try:
        write_merged(placed, out, reading_progress(False, "merging the recordings"))
    except RuntimeError as error:
        raise Failure(f"{out}: {' '.join(str(error).split())}") from None
    return notes
