"""Plain tables: columns as wide as their widest cell, or as a terminal permits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from textwrap import wrap

GAP = 2
"""Spaces between columns."""
NARROWEST = 8
"""No column is made narrower than that."""


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], width: int | None = None, dropped: Sequence[str] = ()
) -> Iterator[str]:
    """Yield the lines of a table; numbers stand to the right.

    To fit into `width` it does without columns of `dropped`, the first first; then long cells are wrapped.
    """
    kept = fitting(head, rows, width, dropped)
    lines = [[row[at] for at in kept] for row in (head, *rows)]
    widths = _widths(lines)
    right = [all(map(is_number, column)) for column in zip(*lines[1:], strict=True)] or [False] * len(kept)
    while width is not None and _total(widths) > width and max(widths) > NARROWEST:
        widths[widths.index(max(widths))] -= 1
    for cells in lines:
        parts = [[cell] if len(cell) <= size else wrap(cell, size) for cell, size in zip(cells, widths, strict=True)]
        for texts in zip_longest(*parts, fillvalue=""):
            yield (
                (" " * GAP)
                .join(
                    text.rjust(size) if to_right else text.ljust(size)
                    for text, size, to_right in zip(texts, widths, right, strict=True)
                )
                .rstrip()
            )


def fitting(head: Sequence[str], rows: Sequence[Sequence[str]], width: int | None, dropped: Sequence[str]) -> list[int]:
    """Return the columns that fit into `width`, all where it is None; of those in `dropped` the first go first."""
    kept = list(range(len(head)))
    if width is None:
        return kept
    widths = _widths([head, *rows])
    for name in dropped:
        if _total([widths[at] for at in kept]) <= width:
            break
        kept = [at for at in kept if head[at] != name]
    return kept


def is_number(cell: str) -> bool:
    """Say whether a cell holds a number, or nothing."""
    return not cell.strip("0123456789.-+e")


def _widths(lines: Sequence[Sequence[str]]) -> list[int]:
    return [max(map(len, column)) for column in zip(*lines, strict=True)]


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + GAP * (len(widths) - 1)
