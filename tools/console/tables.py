"""Tables and text on stdout: they fit the terminal; in a pipe nothing is cut or coloured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from io import StringIO

from rich.console import Console
from rich.table import Table
from rich.text import Text

PIPE_WIDTH = 120
"""Width of the views that always have one, such as `rack status`, where stdout is no terminal."""
GAP = 2
"""Spaces between columns."""
UNLIMITED = 1_000_000


def console() -> Console:
    """Return the console on stdout."""
    found = Console()
    return found if found.is_terminal else Console(width=PIPE_WIDTH)


def terminal_width() -> int | None:
    """Return the width of the terminal on stdout, in characters; None where it is no terminal."""
    found = Console()
    return found.width if found.is_terminal else None


def print_wrapped(text: str) -> None:
    """Print text; on a terminal, wrap long lines between words."""
    terminal = console()
    terminal.print(text, highlight=False, markup=False) if terminal.is_terminal else print(text)


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], width: int | None = None, dropped: Sequence[str] = ()
) -> Iterator[str]:
    """Yield the lines of a table, as plain text; columns of numbers are right-aligned.

    To fit `width` it leaves out columns named in `dropped`, in that order, then wraps long cells.
    """
    printer = Console(file=StringIO(), width=width or UNLIMITED, color_system=None)
    with printer.capture() as captured:
        printer.print(grid(head, rows, printer.width, dropped))
    yield from (line.rstrip() for line in captured.get().splitlines())


def grid(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    width: int,
    dropped: Sequence[str] = (),
    style: Callable[[str, str], str] = lambda column, text: "",
) -> Table:
    """Return the same table for rich to draw; `style` gives the style of a cell by its column and text."""
    columns = list(zip(head, *rows, strict=True))
    for name in dropped:
        if sum(max(map(len, column)) for column in columns) + GAP * (len(columns) - 1) <= width:
            break
        columns = [column for column in columns if column[0] != name]
    drawn = Table(box=None, pad_edge=False, padding=(0, GAP, 0, 0), header_style="dim")
    for name, *cells in columns:
        is_right = bool(cells) and all(map(is_number, cells))
        drawn.add_column(Text(name), justify="right" if is_right else "left", overflow="fold")
    for row in zip(*(cells for _, *cells in columns), strict=True):
        drawn.add_row(*(Text(text, style=style(column[0], text)) for column, text in zip(columns, row, strict=True)))
    return drawn


def is_number(cell: str) -> bool:
    """Return whether a cell holds a number, or nothing."""
    return not cell.strip("0123456789.-+e")
