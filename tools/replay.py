"""`rack replay`: open the recording of a run in the viewer."""

from __future__ import annotations

from pathlib import Path

from tools.answer import Failure
from tools.report import RunFolder


def replay(run: RunFolder) -> None:
    """Open a run in the viewer: the arm, curves, a Gantt lane a task, what happened. Returns when it is closed."""
    from tools.viewer.window import Window

    # A run's folder, or the file in it: both are what a user may point at.
    recording = run if run.suffix == ".rrd" else run / "run.rrd"
    if not recording.is_file():
        raise Failure(f"{run}: no recording for the viewer, it has no {recording.name}", 2)
    if problem := Window(str(Path(recording).resolve())).wait():
        raise Failure(problem)
