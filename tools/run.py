"""`rack run`: launch a rack, watch it, record it, report."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tools.answer import ConfigName, Failure, Faults, Json, Settings, print_json
from tools.interrupt import INTERRUPT

if TYPE_CHECKING:
    from tools.running import RunResult

Lockstep = Annotated[bool, typer.Option("--lockstep", help="a tick begins when every task due has finished: exact")]
Seconds = Annotated[
    float | None, typer.Option(metavar="S", min=0.0, help="simulated time to run for; default: until the task ends")
]
Speed = Annotated[
    float | None, typer.Option(metavar="X", help="run this many times faster than real time, or slower: 0.5")
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

    The exit status is 0 when the task was done and no fault is latched; Ctrl-C ends the run in order, with a report
    and 130.
    """
    from boards.config import load
    from tools.display import display_for
    from tools.folders import folder_of
    from tools.running import NO_TIME, run_rack

    if view and no_record:
        raise Failure("--view and --no-record: the viewer shows what the recorder takes; leave one out", 2)
    overrides = list(settings)
    overrides += ["clock.mode=lockstep"] if lockstep else []
    overrides += [f"clock.speed={speed}"] if speed is not None else []
    found = load(config, overrides, faults)
    folder = None if no_record else folder_of(out, found.name)
    if folder is not None:
        # Now, and not when somebody waits for the end.
        import tools.reporting.report  # noqa: F401
    # From the start of the run to the end of its report; the launch in between ends at once.
    with INTERRUPT.orderly(unfinished=NO_TIME.format(folder) if folder else ""):
        with display_for(silent=as_json) as display:
            result = run_rack(found, seconds, folder, display, view, share)
        report, text = (result.document(), result.text()) if folder is None else _report(folder, result)
        print_json(report) if as_json else print(text)
    if not result.worked:
        # Last, and by itself: whoever looks only at the end, or only at stderr, sees why.
        print(result.failure(), file=sys.stderr)
    sys.exit(0 if result.worked else 1)


def _report(folder: Path, result: RunResult) -> tuple[dict[str, Any], str]:
    """Make the report; a recording that cannot be read spoils no run."""
    from tools.reporting.report import write_report

    try:
        return write_report(folder)
    except (Failure, OSError) as error:
        print(f"no report: {error}", file=sys.stderr)
        return result.document(), result.text()
