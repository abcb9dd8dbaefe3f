"""Tables and their cells as text: they fit the terminal; in a pipe, and as Markdown, nothing is cut
or coloured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
    each key.
    """
    return fitted([*records[0]], [[*map(str, one.values())] for one in records], dropped)


def grid(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    width: int,
    dropped: Sequence[str] = (),
    style: Callable[[str, str], str] = lambda column, text: "",
) -> Table:
    """Return the same table for rich to draw; `style` gives the style of a cell by its column and
    text.
    """
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


Cell = str | float | None
"""Text, or a number without trailing zeros; None for "-"."""


@dataclass(frozen=True)
class TextTable:
    """A table as data: of each row the cells by column. `dropped` are columns that a narrow
    terminal leaves out, the first of them first.
    """

    records: Sequence[Mapping[str, Cell]]
    dropped: Sequence[str] = ()

    @property
    def head(self) -> list[str]:
        """The names of the columns; none without a row."""
        return [*self.records[0]] if self.records else []

    @property
    def rows(self) -> list[list[str]]:
        """The cells as text."""
        return [[cell_text(cell) for cell in record.values()] for record in self.records]


def cell_text(cell: Cell) -> str:
    """Return a cell as text."""
    if cell is None:
        return "-"
    return f"{cell:g}" if isinstance(cell, float) else str(cell)


Blocks = Iterator[str | TextTable]
"""A text for people, line by line, with tables in it; a line that begins with "#" is a title."""


def render_markdown(blocks: Iterable[str | TextTable]) -> str:
    """Return a text as Markdown, with all columns."""
    lines: list[str] = []
    for block in blocks:
        if isinstance(block, TextTable):
            lines += markdown_table(block.head, block.rows)
        else:
            lines.append(block)
    return "\n".join(lines) + "\n"


def render_text(blocks: Iterable[str | TextTable], width: int | None = None) -> Iterator[str]:
    """Yield the lines of a text, its tables as `table` fits them to `width`."""
    for block in blocks:
        if isinstance(block, TextTable):
            yield from table(block.head, block.rows, width, block.dropped)
        else:
            yield block


def show_blocks(blocks: Iterable[str | TextTable], terminal: Console) -> None:
    """Print a text on a terminal: tables show as many columns as fit, and titles are bold."""
    for line in render_text(blocks, terminal.width):
        is_title = line.startswith("#")
        text = line.lstrip("# ") if is_title else line
        terminal.print(text, style="bold" if is_title else "", highlight=False, markup=False)


def print_blocks(blocks: Iterable[str | TextTable]) -> None:
    """Print a text on stdout: as it fits a terminal, or else whole."""
    terminal = console()
    if terminal.is_terminal:
        show_blocks(blocks, terminal)
    else:
        print(*render_text(blocks), sep="\n")


def decimal(value: float | None, digits: int = 3) -> str:
    """Return a number with so many decimals; "-" for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def figure(found: Mapping[str, Any] | None, key: str) -> str:
    """Return one figure of a distribution; "-" where there is none."""
    return "-" if found is None else decimal(found[key])


def ms(time_ns: float | None) -> str:
    """Return a time in ms, to the us, without trailing zeros; "-" for None."""
    return "-" if time_ns is None else f"{time_ns * 1e-6:.3f}".rstrip("0").rstrip(".")
