"""Chains of boards above each other that have the same timing, and their names as text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass


def spanned(names: Sequence[str]) -> str:
    """Return names as text; of three or more that are numbered in order the first and the last,
    "joint1 ... joint6".
    """
    rows: list[list[str]] = []
    for name in names:
        if rows and name == _following(rows[-1][-1]):
            rows[-1].append(name)
        else:
            rows.append([name])
    return ", ".join(f"{row[0]} ... {row[-1]}" if len(row) > 2 else ", ".join(row) for row in rows)


def _following(name: str) -> str:
    """Return the name that is numbered one higher; empty if the name has no number."""
    part = re.fullmatch(r"(.*?)(\d+)(\D*)", name)
    return f"{part[1]}{int(part[2]) + 1}{part[3]}" if part else ""


@dataclass(frozen=True)
class ParallelChains:
    """Chains of boards, highest first, of equal cycles, in ticks: every combination of the boards
    of each level.

    A rack with a board for every joint has one chain for each, and one answer for all of them.
    """

    chains: tuple[tuple[str, ...], ...]
    cycles: tuple[int, ...]

    @property
    def levels(self) -> tuple[str, ...]:
        """The boards of each level, as text."""
        return tuple(
            spanned(tuple(dict.fromkeys(boards))) for boards in zip(*self.chains, strict=True)
        )

    @property
    def bound(self) -> int:
        """The bound on the system's response along them, n R_max for n levels (eq. 3.2), ticks."""
        return len(self.cycles) * max(self.cycles, default=0)

    @property
    def text(self) -> str:
        """All of them in one line: "trajectory > joint1 ... joint6 > arm"."""
        return " > ".join(self.levels)
