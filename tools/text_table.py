"""Plain tables: columns as wide as their widest cell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

GAP = 2
"""Spaces between columns."""


def fitting(head: Sequence[str], rows: Sequence[Sequence[str]], width: int, dropped: Sequence[str]) -> list[int]:
    """Return the columns that fit into `width`; of those in `dropped` the first go first."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    kept = list(range(len(head)))
    for name in dropped:
        if sum(widths[at] + GAP for at in kept) - GAP <= width:
            break
        kept = [at for at in kept if head[at] != name]
    return kept


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a table; numbers stand to the right."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    right = [all(is_number(row[at]) for row in rows) for at in range(len(head))]
    for cells in (head, *rows):
        yield (
            (" " * GAP)
            .join(
                cell.rjust(width) if to_right else cell.ljust(width)
                for cell, width, to_right in zip(cells, widths, right, strict=True)
            )
            .rstrip()
        )


def is_number(cell: str) -> bool:
    """Say whether a cell holds a number, or nothing."""
    return not cell.strip("0123456789.-+e")
