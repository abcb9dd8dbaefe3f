"""`rack replay`: open the recording of a run in the viewer."""

from __future__ import annotations

from rack.tools.console.answer import Failure
from rack.tools.console.parameters import RunFolder
from rack.tools.runs.window import ViewerWindow


def replay(run: RunFolder) -> None:
    """Open the recording of a run in the viewer; return when it is closed.

    It shows the arm in 3D, its curves, a Gantt lane for each task, and the log. RUN may also be a run.rrd.

    \b
    Examples:
      rack replay runs/nasrem-20250101-120000
    """
    # A restarted recorder leaves several files.
    recordings = [run] if run.suffix == ".rrd" else sorted(run.glob("run*.rrd"))
    if not recordings or not all(recording.is_file() for recording in recordings):
        raise Failure(f"{run}: nothing to replay: it has no run.rrd", 2)
    if problem := ViewerWindow(*(str(recording.resolve()) for recording in recordings)).wait():
        raise Failure(problem)
