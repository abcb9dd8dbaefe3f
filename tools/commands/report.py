"""`rack report`: report on a run, from its recording."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from rack.tools.console.parameters import Json, RunFolder
from rack.tools.timing.analysis.stored import print_report, show_report

Against = Annotated[
    Path | None,
    typer.Option(metavar="RUN", help="another run: find the first tick at which the two diverge"),
]


def report(run: RunFolder, against: Against = None, as_json: Json = False) -> None:
    """Report on a run, from its recording.

    It writes report.json and report.md, unless those of the run are newer than its recording and
    this program. On a terminal the tables show as many columns as fit; report.md has all.

    Exit status: 0 the report was printed; 1 with --against: the runs diverge before any miss; 2 RUN
    is not a run.

    \b
    Examples:
      rack report runs/nasrem-20250101-120000
      rack report runs/a --against runs/b
    """
    if against is None:
        show_report(run, as_json)
        return
    from rack.tools.timing.analysis.report import write_report

    data, text = write_report(run, against)
    print_report(data, text, as_json)
    if not data["against"]["explained"]:
        sys.exit(1)
