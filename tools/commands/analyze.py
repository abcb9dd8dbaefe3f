"""`rack analyze`: compare a run with the timing model."""

from __future__ import annotations

import sys
from pathlib import Path

from rack.tools.console.answer import Failure, print_json, write_json
from rack.tools.console.parameters import Json, argument, option
from rack.tools.console.progress import create_reading_progress
from rack.tools.console.tables import print_blocks
from rack.tools.recording.recording import Recording
from rack.tools.report.analysis import Analysis
from rack.tools.report.tables import build_document, format_analysis
from rack.tools.timing.operator_response import show_response


def analyze(
    runs: list[Path] = argument(
        "RUN...", "folder of a run, as in runs/nasrem-20250101-120000; or one of each rack"
    ),
    percentile: float = option(
        "--percentile P",
        "judge by the longest of P in 100 cycles, as in 99.9; by default of all, as in eq. 3.6",
        100.0,
        min=1.0,
        max=100.0,
    ),
    response: bool = option(
        "--response", "instead: the response to an operator's commands, with its bounds", False
    ),
    out: Path | None = option("--out DIR", "folder for the results; default: the run's own"),
    verbose: bool = option("--verbose", "add the tables of levels, tasks and equations", False),
    as_json: Json = False,
) -> None:
    """Compare a run with the timing model, equation by equation.

    Each equation that `rack check` predicts is shown with its measurement. Level times are
    processor times, which exclude waiting and preemption. If the host stalls a virtual machine, the
    stall counts as processor time. Cycles with a detected stall are excluded. To exclude undetected
    stalls as well, --percentile 99 ignores the longest cycle in 100.

    The first line is the verdict. It is followed by the failed equations, worst first, with value,
    bound and excess, or else by the smallest margin; then what to do, and what was not judged.
    --verbose adds all levels, tasks and equations. The command writes analysis.json.
    `rack gantt RUN` shows when each task had its core.

    With the runs of several racks that exchanged messages, the command instead measures the
    responses across these racks. It follows each message through all of them, and compares the
    longest response along each path with its bound (`rack check` with several configs). It shows
    where the longest response spent its time, and why bounds were exceeded: lost messages, a delay
    beyond delay_ms, or late cycles and boards, by rack. In real time, a bound counts as held only
    if that is certain despite the uncertainty of the clock comparison.

    Exit status: 0 every equation or bound held; 1 one failed; 2 the runs cannot be analyzed.

    \b
    Examples:
      rack analyze runs/nasrem-20250101-120000
      rack analyze runs/nasrem-20250101-120000 --percentile 99.9
      rack analyze runs/brown-20250101-120000 runs/brown-servo-20250101-120001
    """
    run, *others = runs
    if others:
        if response or verbose or out is not None or percentile < 100.0:
            raise Failure("--percentile, --response, --out and --verbose take one RUN", 2)
        _analyze_racks([Recording(each) for each in runs], as_json)
        return
    folder = run if out is None else out
    if response:
        if not show_response(Recording(run), folder, as_json):
            sys.exit(1)
        return
    progress = create_reading_progress(silent=as_json)
    analysis = Analysis.from_recording(Recording(run), percentile, progress)
    analysis_document = build_document(analysis)
    progress(0.9)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "analysis.json", analysis_document)
    if as_json:
        print_json(analysis_document)
    else:
        print_blocks((*format_analysis(analysis, verbose), "", f"{folder}/analysis.json"))
    if not analysis.is_fulfilled:
        sys.exit(1)


def _analyze_racks(recordings: list[Recording], as_json: bool) -> None:
    """Print the responses across racks. Exit with status 1 if a bound is exceeded."""
    # Import late, because most runs are analyzed alone.
    from rack.tools.timing.joined_runs import format_joined_runs, measure_joined_runs

    across = measure_joined_runs(recordings)
    if as_json:
        print_json({"racks": [each.layout.rack for each in recordings], "across": across})
    else:
        print_blocks(format_joined_runs(across))
    if any(one["holds"] is False for one in across):
        sys.exit(1)
