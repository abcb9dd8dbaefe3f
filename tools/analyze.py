"""`rack analyze`: what a run says of the timing model."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from rack.tools.answer import Json, print_json
from rack.tools.report import RunFolder

Percentile = Annotated[
    float,
    typer.Option(
        metavar="P",
        min=1.0,
        max=100.0,
        help="judge the longest of P in 100 cycles, as 99.9; 100: of all, as eq. 3.6 has it",
    ),
]
Out = Annotated[Path | None, typer.Option(metavar="DIR", help="folder for what is written; default: the run's own")]


OnlyResponse = Annotated[
    bool, typer.Option("--response", help="instead: the response to an operator's commands, beside its bounds")
]


def analyze(
    run: RunFolder,
    percentile: Percentile = 100.0,
    response: OnlyResponse = False,
    out: Out = None,
    as_json: Json = False,
) -> None:
    """Say of a run what `rack check` says of a config: every equation of the timing model, predicted beside measured.

    Times of levels are processor time: neither waiting nor being preempted counts. A virtual machine that its host
    stalls counts that as processor time too; --percentile 99 leaves out what happens less than once in 100 cycles.
    Tells which cycle broke which equation, and who had its core meanwhile. Writes analysis.json, residuals.png and
    residuals.svg. The exit status is 0 when every equation held, 1 when one did not.
    """
    from rack.tools.analysis.analysis import Analysis
    from rack.tools.analysis.document import document
    from rack.tools.analysis.plot import plot
    from rack.tools.analysis.text import text
    from rack.tools.charting.progress import part_for
    from rack.tools.live_table import print_wrapped, terminal_width
    from rack.tools.recording import Recording

    if response:
        from rack.tools.timing.operator_response import show

        sys.exit(0 if show(Recording(run), run if out is None else out, as_json) else 1)
    with part_for(silent=as_json) as told:
        analysis = Analysis.of(Recording(run), percentile, told)
        folder = run if out is None else out
        folder.mkdir(parents=True, exist_ok=True)
        found = document(analysis)
        told(0.9)
        (folder / "analysis.json").write_text(json.dumps(found, indent=2) + "\n")
        plot(analysis, folder / "residuals")
    if as_json:
        print_json(found)
    else:
        print_wrapped(f"{text(analysis, terminal_width())}\n\n{folder}/analysis.json, residuals.png, residuals.svg")
    sys.exit(0 if analysis.holds else 1)
