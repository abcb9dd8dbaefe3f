"""Draws pictures with matplotlib, as PNG and SVG.

matplotlib is an optional dependency and takes a second to import. Only modules that draw may import
it, after `can_draw`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from rack.tools.console.answer import Failure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURE_FORMATS = ("png", "svg")
DPI = 150
NO_PICTURES = "no pictures: they need matplotlib: pip install 'nasrem-rack[charts]'"


def can_draw() -> bool:
    """Return whether matplotlib is installed. If not, `NO_PICTURES` tells the user what to do."""
    return find_spec("matplotlib") is not None


def check_picture_path(option: str, path: Path) -> None:
    """Raise `Failure` if a picture cannot be drawn, or not into this file.

    Args:
        option: Option that gives the file, for the message.
        path: The file.
    """
    if path.suffix[1:] not in PICTURE_FORMATS:
        raise Failure(f"{option} {path}: the name of a picture must end in .png or .svg", 2)
    if not can_draw():
        raise Failure(NO_PICTURES)


@contextmanager
def open_figure(paths: Sequence[Path], width_in: float, height_in: float) -> Iterator[Figure]:
    """Provide an empty figure, and save it at the end. Equal figures give identical files.

    Args:
        paths: Files to write, with endings in `PICTURE_FORMATS`.
        width_in: Width in inches.
        height_in: Height in inches.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "rack", "font.size": 9}):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        yield figure
        for path in paths:
            metadata = {"Date": None} if path.suffix == ".svg" else None
            figure.savefig(path, dpi=DPI, metadata=metadata)


def list_picture_paths(stem: Path) -> list[Path]:
    """List the paths of a picture: `stem`.png and `stem`.svg."""
    return [stem.with_name(f"{stem.name}.{kind}") for kind in PICTURE_FORMATS]
