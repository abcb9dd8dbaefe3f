"""`rack report`: report on a run, from its recording."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from rack.tools.analysis.report import write_report
from rack.tools.analysis.report_markdown import show
from rack.tools.console.answer import Json, RunFolder, print_json
from rack.tools.console.tables import console

Against = Annotated[
    Path | None, typer.Option(metavar="RUN", help="another run: find the first tick at which the two diverge")
]


def report(run: RunFolder, against: Against = None, as_json: Json = False) -> None:
    """Report on a run, from its recording.

    It writes report.json and report.md anew. On a terminal the tables show as many columns as fit; report.md has all.

    Exit status: 0 the report was written; 1 with --against: the runs diverge before any miss; 2 RUN is not a run.

    \b
    Examples:
      rack report runs/nasrem-20250101-120000
      rack report runs/a --against runs/b
    """
    data, text = write_report(run, against)
    print_report(data, text, as_json)
    sys.exit(0 if against is None or data["against"]["explained"] else 1)


def print_report(data: dict[str, Any], text: str, as_json: bool) -> None:
    """Print a report: as one JSON document; on a terminal as much as fits; elsewhere, or of no recording, `text`."""
    if as_json:
        print_json(data)
    elif (terminal := console()).is_terminal and data["folder"] is not None:
        show(data, terminal)
    else:
        print(text)
