"""Formats tables and their cells as text.

On a terminal they fit its width, and in a pipe 100 columns. As Markdown they are not cut.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rack.tools.console.answer import PIPE_WIDTH, print_text

GAP = 2
"""Number of spaces between columns."""
WRAPPED_WIDTH = 25
"""Width down to which a column is wrapped before other columns are left out."""
UNLIMITED_WIDTH = 1_000_000
"""Width of a table that is neither cut nor wrapped."""


def create_console(pipe_width: int = PIPE_WIDTH) -> Console:
    """Return a rich console on stdout. It has `pipe_width` if stdout is not a terminal."""
    stdout_console = Console()
    return stdout_console if stdout_console.is_terminal else Console(width=pipe_width)


def format_table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    width: int | None = None,
    dropped: Sequence[str] = (),
) -> Iterator[str]:
    """Yield the lines of a table as plain text. Columns of numbers are right-aligned.

    Args:
        head: Names of the columns.
        rows: Cells of each row.
        width: Maximum width. None for no limit.
        dropped: Columns to leave out, in this order, until the table fits. Then long cells are
            wrapped.
    """
    printer = Console(file=StringIO(), width=width or UNLIMITED_WIDTH, color_system=None)
    with printer.capture() as captured:
        printer.print(build_grid(head, rows, printer.width, dropped))
    yield from (line.rstrip() for line in captured.get().splitlines())


def format_fitted_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], dropped: Sequence[str] = ()
) -> Iterator[str]:
    """Yield the lines of a table, fitted to the terminal or to `PIPE_WIDTH`.

    Args:
        head: Names of the columns.
        rows: Cells of each row.
        dropped: Columns that a narrow output leaves out, in this order.
    """
    return format_table(head, rows, create_console().width, dropped)


def format_fitted_records(
    records: Sequence[Mapping[str, object]], dropped: Sequence[str] = ()
) -> Iterator[str]:
    """Yield the lines of a table with a row for each record, as `format_fitted_table` does.

    The keys of the first record are the columns.
    """
    return format_fitted_table(
        [*records[0]], [[*map(str, record.values())] for record in records], dropped
    )


def build_grid(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    width: int,
    dropped: Sequence[str] = (),
    style: Callable[[str, str], str] = lambda column, text: "",
) -> Table:
    """Build a rich table that fits a width.

    Args:
        head: Names of the columns.
        rows: Cells of each row.
        width: Maximum width.
        dropped: Columns to leave out, in this order, until the table fits.
        style: Returns the style of a cell, given its column and text.
    """
    columns = list(zip(head, *rows, strict=True))
    for name in dropped:
        widths = [min(max(map(len, column)), WRAPPED_WIDTH) for column in columns]
        if sum(widths) + GAP * (len(columns) - 1) <= width:
            break
        columns = [column for column in columns if column[0] != name]
    rich_table = Table(box=None, pad_edge=False, padding=(0, GAP, 0, 0), header_style="dim")
    for name, *cells in columns:
        is_right = bool(cells) and all(map(is_number, cells))
        rich_table.add_column(Text(name), justify="right" if is_right else "left", overflow="fold")
    for row in zip(*(cells for _, *cells in columns), strict=True):
        rich_table.add_row(
            *(
                Text(text, style=style(column[0], text))
                for column, text in zip(columns, row, strict=True)
            )
        )
    return rich_table


def is_number(cell: str) -> bool:
    """Return whether a cell contains a number or is empty."""
    return not cell.strip("0123456789.-+e")


def format_markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a Markdown table, each column as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for number, row in enumerate((head, *rows)):
        yield (
            f"| {' | '.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))} |"
        )
        if number == 0:
            yield f"|{'|'.join('-' * (width + 2) for width in widths)}|"


Cell = str | float | None
"""A text or a number. Numbers are shown without trailing zeros, None as "-"."""


@dataclass(frozen=True)
class TextTable:
    """A table as data.

    Attributes:
        records: For each row, a dictionary from column to cell.
        dropped: Columns that a narrow terminal leaves out, in this order.
    """

    records: Sequence[Mapping[str, Cell]]
    dropped: Sequence[str] = ()

    @property
    def head(self) -> list[str]:
        """Names of the columns. Empty for a table without rows."""
        return [*self.records[0]] if self.records else []

    @property
    def rows(self) -> list[list[str]]:
        """Cells as text, row by row."""
        return [[format_cell(cell) for cell in record.values()] for record in self.records]


def format_cell(cell: Cell) -> str:
    """Format a cell as text. None becomes a dash."""
    if cell is None:
        return "-"
    return f"{cell:g}" if isinstance(cell, float) else str(cell)


Blocks = Iterator[str | TextTable]
"""Lines of text and tables, in reading order. A line that begins with "#" is a title."""


def render_markdown(blocks: Iterable[str | TextTable]) -> str:
    """Format text and tables as Markdown, with all columns of the tables."""
    lines: list[str] = []
    for block in blocks:
        if isinstance(block, TextTable):
            lines += format_markdown_table(block.head, block.rows)
        else:
            lines.append(block)
    return "\n".join(lines) + "\n"


def render_text(blocks: Iterable[str | TextTable], width: int | None = None) -> Iterator[str]:
    """Yield lines of text and of tables. Tables are fitted to `width`, unless it is None."""
    for block in blocks:
        if isinstance(block, TextTable):
            yield from format_table(block.head, block.rows, width, block.dropped)
        else:
            yield block


def print_blocks(blocks: Iterable[str | TextTable], terminal: Console | None = None) -> None:
    """Print text and tables, fitted to the terminal or to `PIPE_WIDTH`. Titles have no "#".

    Args:
        blocks: Text and tables.
        terminal: Terminal or pipe. None for stdout.
    """
    terminal = terminal or create_console()
    for line in render_text(blocks, terminal.width):
        text = line.lstrip("# ") if line.startswith("#") else line
        if terminal.is_terminal:
            style = "bold" if line.startswith("#") else ""
            terminal.print(text, style=style, highlight=False, markup=False)
        else:
            print_text([text], terminal.file)


def format_decimal(value: float | None, digits: int = 3) -> str:
    """Format a number with a fixed number of decimals, or return "-" for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def format_figure(distribution: Mapping[str, Any] | None, key: str, digits: int = 3) -> str:
    """Format one value of a distribution, or return "-" if the distribution is None."""
    return "-" if distribution is None else format_decimal(distribution[key], digits)


def format_ms(time_ns: float | None) -> str:
    """Format a time in ms, to the microsecond, without trailing zeros. Return "-" for None."""
    return "-" if time_ns is None else f"{time_ns * 1e-6:.3f}".rstrip("0").rstrip(".")
