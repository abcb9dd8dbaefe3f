"""`rack run`: launch a rack, watch it, record it, report."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rack.tools.answer import ConfigName, Failure, Faults, Json, Settings
from rack.tools.interrupt import INTERRUPT

if TYPE_CHECKING:
    from rack.boards.config.schema import RackConfig
    from rack.tools.running import RunResult

Lockstep = Annotated[
    bool, typer.Option("--lockstep", help="begin a tick when every task due has finished: exact and repeatable")
]
Seconds = Annotated[
    float | None, typer.Option(metavar="S", min=0.0, max=1e9, help="simulated time to run for; default: until it ends")
]
Speed = Annotated[
    float | None, typer.Option(metavar="X", help="run this many times as fast as real time, as in 2 or 0.5")
]
Out = Annotated[Path | None, typer.Option(metavar="DIR", help="folder of the run; default: runs/<rack>-<time>")]
View = Annotated[bool, typer.Option("--view", help="open the viewer on the running rack")]
Share = Annotated[
    bool, typer.Option("--share", help="run on cores that another rack's real-time boards hold, too: both will be late")
]
NoRecord = Annotated[bool, typer.Option("--no-record", help="leave no folder: no trace, no signals, no report")]


def run(
    config: ConfigName,
    lockstep: Lockstep = False,
    seconds: Seconds = None,
    speed: Speed = None,
    settings: Settings = [],  # noqa: B006  typer copies it
    faults: Faults = None,
    out: Out = None,
    no_record: NoRecord = False,
    view: View = False,
    share: Share = False,
    as_json: Json = False,
) -> None:
    """Run a rack until its task ends, and report on it.

    On a terminal a live table shows every task, and what holds the rack; elsewhere a line a second does. --json prints
    the report as one document, with the same keys whether the run was recorded or not; what only a recording
    knows is null then.

    Exit status: 0 the task was done, or --seconds are over, and no fault is latched; 1 otherwise; 2 usage or config.
    Ctrl-C ends the run in order, with a report and 130.

    \b
    Examples:
      rack run nasrem
      rack run nasrem --lockstep --seconds 5 --no-record --json | jq -r .digest
    """
    from rack.boards.config import load
    from rack.tools.display import display_for
    from rack.tools.folders import folder_of
    from rack.tools.report import print_report
    from rack.tools.running import NO_TIME, run_rack

    if view and no_record:
        raise Failure("--view and --no-record: the viewer shows what the recorder takes; leave one out", 2)
    overrides = list(settings)
    overrides += ["clock.mode=lockstep"] if lockstep else []
    overrides += [f"clock.speed={speed}"] if speed is not None else []
    found = load(config, overrides, faults)
    folder = None if no_record else folder_of(out, found.name)
    # From the start of the run to the end of its report; the launch in between ends at once.
    with INTERRUPT.orderly(unfinished=NO_TIME.format(folder) if folder else ""):
        with display_for(silent=as_json) as display:
            result = run_rack(found, seconds, folder, display, view, share)
        print_report(*_report(found, folder, result), as_json)
    if not result.worked:
        # Last, and by itself: whoever looks only at the end, or only at stderr, sees why.
        print(result.failure(), file=sys.stderr)
    sys.exit(0 if result.worked else 1)


def _report(config: RackConfig, folder: Path | None, result: RunResult) -> tuple[dict[str, Any], str]:
    """Make the report; a recording that cannot be read spoils no run."""
    from rack.tools.analysis.report import unrecorded, write_report

    try:
        if folder is not None:
            return write_report(folder)
    except (Failure, OSError) as error:
        print(f"no report: {error}", file=sys.stderr)
    return unrecorded(config, result.document()), result.text()
