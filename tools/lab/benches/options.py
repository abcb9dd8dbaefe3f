"""What the commands of `rack bench` have in common: options, and how they show what they found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeVar

import typer

from rack.tools.console.answer import print_json
from rack.tools.console.parameters import config_names

if TYPE_CHECKING:
    from rack.tools.console.progress import Progress

Config = Annotated[
    str,
    typer.Option(
        "--config",
        metavar="CONFIG",
        help="config by name, or path to a .toml file",
        autocompletion=config_names,
    ),
]

Plot = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="write the figures as PNG and SVG into this folder"),
]
Against = Annotated[
    Path | None,
    typer.Option(metavar="TREE", help="another checkout of rack, measured by turns with this one"),
]
Share = Annotated[
    bool,
    typer.Option(
        "--share", help="run even on cores held by another rack's real-time boards: figures suffer"
    ),
]
Rates = Annotated[
    list[float] | None,
    typer.Option(
        "--rate", metavar="HZ", min=1, max=10_000, help="rate; may be given several times"
    ),
]
Rounds = Annotated[
    int, typer.Option(metavar="N", min=1, help="rounds; every contestant is measured once in each")
]
RackRounds = Annotated[int, typer.Option(metavar="N", min=1, help="runs of each rack, by turns")]
Seconds = Annotated[float, typer.Option(metavar="S", min=0.1, help="time of one measurement")]


class BenchResult(Protocol):
    """What a bench has found, as far as it is shown."""

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield it as text for people, fitted to `width`."""

    def plot(self, folder: Path) -> list[Path]:
        """Write its pictures into `folder`; return their paths."""


Found = TypeVar("Found", bound=BenchResult)


def show(measure: Callable[[Progress], Found], plot: Path | None, as_json: bool) -> Found:
    """Measure, with the progress on the terminal; print what was found and, if asked for, plot it.
    Return it."""
    from rack.tools.console.progress import progress_for
    from rack.tools.console.tables import terminal_width

    with progress_for(as_json) as progress:
        found = measure(progress)
    print_found(found.document(), found.lines(terminal_width()), as_json)
    if plot is not None:
        plot.mkdir(parents=True, exist_ok=True)
        paths = found.plot(plot)
        if not as_json:
            print(f"pictures: {', '.join(map(str, paths))}")
    return found


def print_found(document: dict[str, Any], lines: Iterable[str], as_json: bool) -> None:
    """Print what was found: for people, or as one JSON document."""
    from rack.tools.console.tables import print_wrapped

    print_json(document) if as_json else print_wrapped("\n".join(lines))
