"""Options that commands of `rack bench` have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rack.tools.console.parameters import config_names

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
