"""`rack gantt`: draw the schedule of a config, or the trace of a run, as a Gantt chart."""

from __future__ import annotations

import sys
from pathlib import Path

from rack.tools.console.answer import Document, Failure, print_answer
from rack.tools.console.parameters import Json, Settings, argument, option
from rack.tools.console.pictures import NO_PICTURES, can_draw
from rack.tools.console.progress import create_reading_progress
from rack.tools.timing.charts import figure5
from rack.tools.timing.charts.gantt import Subject, WindowOptions, build_gantt, find_subject
from rack.tools.timing.charts.panel import NS_PER_MS

LATEST_MS = 1e10
MANY_SPANS = 10_000
"""Number of spans from which drawing takes a second or more."""


def gantt(
    subject: str = argument(
        "CONFIG|RUN", "config by name or path, or the folder of a run, as in runs/fig2-..."
    ),
    from_ms: float | None = option(
        "--from-ms MS", "start of the window, ms", min=0.0, max=LATEST_MS
    ),
    to_ms: float | None = option("--to-ms MS", "end of the window, ms", min=0.0, max=LATEST_MS),
    figure: int | None = option(
        "--figure 5", "instead: the paper's figure 5 with the levels of this rack"
    ),
    settings: Settings = [],  # noqa: B006
    out: Path | None = option(
        "--out DIR", "folder for the pictures; default: the run's, or runs/<rack>-gantt"
    ),
    as_json: Json = False,
) -> None:
    """Draw a Gantt chart of the schedule of a config, or of the trace of a run.

    The schedule of a config follows from its budgets. The letters are unit functions: C reads the
    plan, R reads command and status, X executes, W writes, P plans, U updates the plan. "-" marks
    an idle core, "." a core that another board uses. For a run, its trace is drawn above the
    schedule of its config. The chart is printed as text, and drawn as PNG and SVG.

    Figures 2 to 4 of the paper are the racks fig2, fig3 and fig4.

    \b
    Examples:
      rack gantt fig2
      rack gantt fig4-overload --from-ms 60 --to-ms 78
      rack gantt runs/nasrem-20250101-120000 --from-ms 500 --to-ms 540
    """
    drawn_subject = find_subject(subject, settings, out)
    if figure is not None:
        _draw_figure_5(drawn_subject, figure, as_json)
        return
    from_ns, to_ns = (None if ms is None else round(ms * NS_PER_MS) for ms in (from_ms, to_ms))
    chart = build_gantt(
        drawn_subject, WindowOptions(from_ns, to_ns), create_reading_progress(silent=as_json)
    )
    span_count = sum(len(panel.chart.spans) for panel in chart.panels)
    if span_count > MANY_SPANS and not as_json:
        print(f"drawing {span_count} spans", file=sys.stderr, flush=True)
    pictures = chart.save_pictures(_create_folder(drawn_subject.folder)) if can_draw() else []
    _print_chart(chart.format_text(), chart.to_document(), pictures, as_json)


def _draw_figure_5(subject: Subject, figure: int, as_json: bool) -> None:
    """Draw figure 5 of the paper. Raises `Failure` if another figure is requested."""
    if figure != 5:
        raise Failure(
            f"--figure {figure}: must be 5; figures 2 to 4 are racks, as in: rack gantt fig2", 2
        )
    pictures = (
        figure5.save_picture(subject.config, _create_folder(subject.folder) / "figure5")
        if can_draw()
        else []
    )
    text = "\n".join(figure5.format_figure(subject.config))
    _print_chart(text, figure5.build_document(subject.config), pictures, as_json)


def _create_folder(folder: Path) -> Path:
    """Create the folder for the pictures if it is missing, and return it. Raises `Failure`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Failure(f"--out {folder}: cannot create the folder: {error.strerror}", 2) from error
    return folder


def _print_chart(text: str, document: Document, pictures: list[Path], as_json: bool) -> None:
    """Print the chart, with the paths of its pictures."""
    paths = [str(path) for path in pictures]
    files = f"pictures: {', '.join(paths)}" if paths else NO_PICTURES
    print_answer({**document, "pictures": paths}, f"{text}\n\n{files}", as_json)
