"""`rack replay`: open recordings in the viewer, several racks on one time line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import argument, option
from rack.tools.console.progress import create_reading_progress
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.divergence import find_other_run
from rack.tools.recording.file_names import CONFIG
from rack.tools.recording.recording import Recording
from rack.tools.recording.time_line import RackAlignment, align_racks, align_runs
from rack.tools.viewer.parts import FILE, list_parts
from rack.tools.viewer.window import ViewerWindow, has_screen

Places = Callable[[Sequence[Recording]], list[RackAlignment]]
"""Function that puts recordings on one time line."""


def replay(
    runs: list[Path] = argument(
        "RUN...", "folder of a run, as in runs/nasrem-20250101-120000; one for each rack"
    ),
    out: Path | None = option(
        "--out FILE.rrd", "write the recording to a file for the viewer, and do not open it"
    ),
    against: Path | None = option(
        "--against RUN",
        "also show another run of the same rack, or 'origin' for the run that RUN continues",
    ),
) -> None:
    """Open the recording of a run in the viewer, and wait until it is closed.

    The viewer shows the arm in 3D, its curves, a Gantt lane for each task, and the log. RUN may
    also be a run.rrd.

    For several racks that ran together, give the folder of each. They are shown side by side under
    their names, on the time line of the first. Times are converted with the clock offsets that the
    racks recorded of each other, and the log states the uncertainty. Racks that did not run
    together are refused.

    With --against, two runs of one rack, such as a run and its branch, are shown tick by tick on
    one time line, under the names of their folders. The log marks the tick of the branch and the
    first message that differs.

    A run without run.rrd, such as one of a flight recorder ([record] keep), is converted first.

    \b
    Examples:
      rack replay runs/nasrem-20250101-120000
      rack replay runs/cell-puma-20250101-120000 runs/cell-k1607-20250101-120001
      rack replay runs/cell-puma-* runs/cell-k1607-* --out both.rrd
      rack replay runs/slower --against runs/whole
      rack replay runs/slower --against origin
    """
    place: Places = align_racks
    if against is not None:
        if len(runs) > 1:
            raise Failure("--against: give exactly one RUN", 2)
        place = align_runs
        runs = [find_other_run(runs[0], against), *runs]
    if out is None and len(runs) == 1 and (recordings := find_viewer_files(runs[0])):
        _open_viewer(*recordings)
        return
    if out is not None:
        _write_file(runs, out, place)
    elif len(runs) == 1 and not (runs[0] / CONFIG).exists():
        raise Failure(f"{runs[0]}: nothing to replay: it has no run.rrd", 2)
    elif has_screen():
        with INTERRUPT.raise_interrupted(), TemporaryDirectory(prefix="rack-replay-") as folder:
            _write_file(runs, Path(folder, "run.rrd"), place)
            _open_viewer(Path(folder, "run.rrd"))
    else:
        raise Failure(
            "no screen: DISPLAY and WAYLAND_DISPLAY are not set; --out FILE.rrd writes a file"
        )


def find_viewer_files(run: Path) -> list[Path]:
    """Return the viewer's files of a run. A long run and a restarted recorder have several.

    Raises `Failure` for a damaged file.
    """
    is_file = run.suffix == ".rrd"
    checksums = Checksums(run.parent if is_file else run)
    files = [run] if is_file and run.is_file() else list_parts(run / FILE)
    # A killed recorder leaves a file without a checksum, which cannot be verified.
    checksums.verify(*{part.name for part in files} & {*checksums.stored})
    return files


def _open_viewer(*recordings: Path) -> None:
    """Open the viewer and wait until it is closed. Raises `Failure` if it fails."""
    if problem := ViewerWindow(
        *(str(recording.resolve()) for recording in recordings)
    ).wait_until_closed():
        raise Failure(problem)


def _write_file(runs: Sequence[Path], out: Path, place: Places) -> None:
    """Merge runs into the file `out`, and print the messages of `merge_runs` on stderr.

    Raises `Failure` if `out` exists or is not an .rrd file.
    """
    if out.suffix != ".rrd":
        raise Failure(f"--out {out}: the name of a file for the viewer must end in .rrd", 2)
    if out.exists():
        raise Failure(f"--out {out}: exists already", 2)
    for note in merge_runs(runs, out, place):
        print(note, file=sys.stderr)


def merge_runs(runs: Sequence[Path], out: Path, place: Places = align_racks) -> list[str]:
    """Write runs to one file for the viewer.

    Args:
        runs: Run folders.
        out: The file.
        place: Function that puts the runs on one time line. The default is for racks that ran
            together.

    Returns:
        Messages for the user about the times of the runs.

    Raises:
        Failure: A run cannot be read, or the runs have no time in common.
    """
    for run in runs:
        if not run.is_dir():
            why = "not the folder of a run" if run.exists() else "no such folder"
            raise Failure(f"{run}: {why}", 2)
    placed = place([Recording(run) for run in runs])
    tick_s = placed[0].grid.clock_ns * 1e-9
    marks = [mark for recording in placed for mark in recording.marks]
    notes = [f"{tick * tick_s:g} s: {text}" if tick else text for tick, text in marks]
    # Import late, because this takes half a second.
    from rack.tools.viewer.merged import write_merged

    try:
        write_merged(placed, out, create_reading_progress(False, "merging the recordings"))
    except RuntimeError as error:
        raise Failure(f"{out}: {' '.join(str(error).split())}") from None
    return notes
