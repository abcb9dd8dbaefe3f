"""Markdown for files that people read: report.md, and the results of a campaign."""

from __future__ import annotations

from collections.abc import Iterator, Sequence


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a markdown table, each column as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    first, *others = (
        " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows)
    )
    yield f"| {first} |"
    yield "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    yield from (f"| {line} |" for line in others)
