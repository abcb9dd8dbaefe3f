"""Tables and their cells as text: they fit the terminal; in a pipe, and as Markdown, nothing is cut
or coloured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from typing import Any

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
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    width: int | None = None,
    dropped: Sequence[str] = (),
) -> Iterator[str]:
    """Yield the lines of a table, as plain text; columns of numbers are right-aligned.

    To fit `width` it leaves out columns named in `dropped`, in that order, then wraps long cells.
    """
    printer = Console(file=StringIO(), width=width or UNLIMITED, color_system=None)
    with printer.capture() as captured:
        printer.print(grid(head, rows, printer.width, dropped))
    yield from (line.rstrip() for line in captured.get().splitlines())


def fitted(
    head: Sequence[str], rows: Sequence[Sequence[str]], dropped: Sequence[str] = ()
) -> Iterator[str]:
    """Yield the lines of a table that fits the terminal on stdout; where that is none, whole."""
    return table(head, rows, terminal_width(), dropped)


def fitted_records(
    records: Sequence[Mapping[str, object]], dropped: Sequence[str] = ()
) -> Iterator[str]:
    """Yield the lines of such a table, with a row for each record, at least one, and a column for
    each key."""
    return fitted([*records[0]], [[*map(str, one.values())] for one in records], dropped)


def grid(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    width: int,
    dropped: Sequence[str] = (),
    style: Callable[[str, str], str] = lambda column, text: "",
) -> Table:
    """Return the same table for rich to draw; `style` gives the style of a cell by its column and
    text."""
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
        drawn.add_row(
            *(
                Text(text, style=style(column[0], text))
                for column, text in zip(columns, row, strict=True)
            )
        )
    return drawn


def is_number(cell: str) -> bool:
    """Return whether a cell holds a number, or nothing."""
    return not cell.strip("0123456789.-+e")


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a table in Markdown, each column as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for number, row in enumerate((head, *rows)):
        yield (
            f"| {' | '.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))} |"
        )
        if number == 0:
            yield f"|{'|'.join('-' * (width + 2) for width in widths)}|"


@dataclass(frozen=True)
class TextTable:
    """A table as data. `dropped` are columns that a narrow terminal leaves out, the first of them
    first."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    dropped: Sequence[str] = ()

    def markdown(self) -> Iterator[str]:
        """Yield all of it in Markdown."""
        return markdown_table(self.head, self.rows)


Blocks = Iterator[str | TextTable]
"""A text for people, line by line, with tables in it."""


def decimal(value: float | None, digits: int = 3) -> str:
    """Return a number with so many decimals; "-" for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def figure(found: Mapping[str, Any] | None, key: str) -> str:
    """Return one figure of a distribution; "-" where there is none."""
    return "-" if found is None else decimal(found[key])


def ms(time_ns: float | None) -> str:
    """Return a time in ms, to the us, without trailing zeros; "-" for None."""
    return "-" if time_ns is None else f"{time_ns * 1e-6:.3f}".rstrip("0").rstrip(".")
