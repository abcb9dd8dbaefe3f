"""`rack report`: report on a run from its recording."""

from __future__ import annotations

import sys
from pathlib import Path

from rack.tools.console.answer import Failure
from rack.tools.console.parameters import Full, Json, RunFolder, option
from rack.tools.report.stored import load_report, print_report


def report(
    run: RunFolder,
    against: Path | None = option(
        "--against RUN",
        "find where and why RUN diverges from this run, or from 'origin', the run it continues",
    ),
    of: str = option(
        "--of MAILBOX",
        "with --against: start at the first difference in this mailbox, and search for the cause",
        "",
    ),
    repeat: bool = option(
        "--repeat",
        "with --against: if the recordings do not show the cause, run both racks again, with the"
        " levels that their configs name",
        False,
    ),
    full: Full = False,
    as_json: Json = False,
) -> None:
    """Report on a run from its recording.

    The summary has at most 25 lines: the verdict and its reasons, what happened, the tasks that
    lost cycles ("!"), and the causes of these losses. 'proc p99' is the 99th percentile of the
    processor time of a task's cycles. 'used' is its percentage of the cycle, or of a planner's time
    slice. 'late' is the longest time from a release to the start of its cycle. A cause that the
    recording does not show is "not recorded". --full prints all tables, with the columns that fit.

    The command writes report.json and report.md, which have everything, if they are missing or
    older than the recording or this program.

    With --against the report names the first message that differs, its fields, and whether its
    writer had read the same inputs in both runs. If not, the command follows the differing inputs
    back to a cycle with equal inputs, and names the cause: a fault, a loss, a command, a miss or a
    setting. If only the state or the code of the level can be the cause, --repeat runs both racks
    again in lockstep up to that cycle. It reports which attributes of the level differed before the
    cycle, and whether running the cycle again gives the same output. Only --repeat executes code of
    a run; other reports just read recordings.

    Exit status: 0 the report was printed; 1 with --against: the runs diverge before any miss; 2 RUN
    is not a run, or the two cannot be compared: they are of different racks, or one lacks rows.

    \b
    Examples:
      rack report runs/nasrem-20250101-120000
      rack report runs/a --against runs/b
      rack report runs/a --against runs/b --of task.status --repeat
      rack report runs/slower --against origin
    """
    if against is None:
        if of or repeat:
            raise Failure("--of and --repeat need --against", 2)
        print_report(load_report(run), as_json, full)
        return
    from rack.tools.recording.divergence import find_other_run
    from rack.tools.report.report import OtherRun, write_report

    other = find_other_run(run, against)
    data, _ = write_report(run, OtherRun(other, of, repeat))
    print_report(data, as_json, full)
    if not data["against"]["explained"]:
        sys.exit(1)
