"""`rack report`: the report of a run, from its recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tools.answer import Json, print_json

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="folder of a run, as in runs/nasrem-20250101-120000")]


def report(run: RunFolder, as_json: Json = False) -> None:
    """Report on a run, from its recording.

    Makes report.json and report.md anew.
    """
    from tools.reporting.report import write_report

    data, text = write_report(run)
    print_json(data) if as_json else print(text)
