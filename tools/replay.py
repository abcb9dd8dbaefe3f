"""`rack replay`: open the recording of a run in the viewer."""

from __future__ import annotations

from rack.tools.answer import Failure
from rack.tools.report import RunFolder


def replay(run: RunFolder) -> None:
    """Open a run in the viewer: the arm, curves, a Gantt lane a task, what happened. Returns when it is closed."""
    from rack.tools.viewer.window import Window

    # A run's folder, or a file in it: both are what a user may point at. A restarted recorder has left several files.
    recordings = [run] if run.suffix == ".rrd" else sorted(run.glob("run*.rrd"))
    if not recordings or not all(recording.is_file() for recording in recordings):
        raise Failure(f"{run}: no recording for the viewer, it has no run.rrd", 2)
    if problem := Window(*(str(recording.resolve()) for recording in recordings)).wait():
        raise Failure(problem)
