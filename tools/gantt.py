"""`rack gantt`: who computed what, when, on which core: the schedule of a config, or a run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rack.tools.console.answer import Failure, Json, Settings, print_json

if TYPE_CHECKING:
    from rack.tools.charting.subject import Subject

LATEST_MS = 1e10
MANY_SPANS = 10_000
"""Spans that take a second or two to draw."""

SubjectName = Annotated[
    str,
    typer.Argument(metavar="CONFIG|RUN", help="config by name or path, or the folder of a run, as in runs/fig2-..."),
]
From = Annotated[float | None, typer.Option(metavar="MS", min=0.0, max=LATEST_MS, help="begin of the window, ms")]
To = Annotated[float | None, typer.Option(metavar="MS", min=0.0, max=LATEST_MS, help="end of the window, ms")]
Cycles = Annotated[
    str | None, typer.Option(metavar="A-B", help="instead: the cycles to show, counted from 0, as in 10-12")
]
Level = Annotated[
    str | None,
    typer.Option(metavar="LEVEL", help="level whose cycles these are; default: the slowest with a tight planner"),
]
Process = Annotated[
    list[str],
    typer.Option(metavar="LEVEL=MS,MS", help="schedule X of a level with these times, cycle by cycle; repeatable"),
]
Figure = Annotated[
    int | None, typer.Option(metavar="5", help="draw the paper's figure 5 with this rack's levels in it, instead")
]
Out = Annotated[
    Path | None, typer.Option(metavar="DIR", help="folder of the pictures; default: the run's, or runs/<rack>-gantt")
]


def gantt(
    subject: SubjectName,
    from_ms: From = None,
    to_ms: To = None,
    cycles: Cycles = None,
    level: Level = None,
    process: Process = [],  # noqa: B006  typer copies it
    figure: Figure = None,
    settings: Settings = [],  # noqa: B006
    out: Out = None,
    as_json: Json = False,
) -> None:
    """Draw a Gantt chart: of the schedule that a config's budgets make, or of what a run's trace has measured.

    C reads the plan, R command and status, X executes, W writes, P plans, U updates the plan; "-" is an idle core,
    "." another board on it. A run is shown above the schedule of its config. Text on stdout, PNG and SVG in a folder.

    Figures 2 to 4 of the paper are racks: rack gantt fig2, fig3, fig4, fig4-overload.
    """
    from rack.tools.charting.gantt import gantt_of
    from rack.tools.charting.progress import part_for
    from rack.tools.charting.subject import subject_of
    from rack.tools.charting.window import times_of, wanted

    found = subject_of(subject, settings, out)
    if figure is not None:
        _figure_5(found, figure, as_json)
        return
    window = wanted(from_ms, to_ms, cycles, level)
    with part_for(silent=as_json) as told:
        chart = gantt_of(found, window, times_of(process), told)
    if chart.spans > MANY_SPANS and not as_json:
        print(f"drawing {chart.spans} spans", file=sys.stderr, flush=True)
    _answer(chart.text(), chart.document(), chart.save(_made(found.folder)), as_json)


def _figure_5(found: Subject, figure: int, as_json: bool) -> None:
    from rack.tools.charting import regions, regions_picture

    if figure != 5:
        raise Failure(f"--figure {figure}: permitted: 5; figures 2 to 4 are racks, as in: rack gantt fig2", 2)
    paths = regions_picture.save(found.config, _made(found.folder) / "figure5")
    _answer("\n".join(regions.lines(found.config)), regions.document(found.config), paths, as_json)


def _made(folder: Path) -> Path:
    """Return the folder of the pictures, made where there is none."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Failure(f"{folder}: no place for pictures: {error.strerror}", 2) from error
    return folder


def _answer(text: str, document: dict[str, Any], pictures: list[Path], as_json: bool) -> None:
    if as_json:
        print_json({**document, "pictures": [str(path) for path in pictures]})
        return
    print(text)
    print(f"\npictures: {', '.join(map(str, pictures))}")
