"""Groups of chains of boards that have the same timing, and their names as text."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T", bound=Hashable)


def format_names(names: Sequence[str]) -> str:
    """Return names as text, with consecutive numbers shortened to "joint1 ... joint6"."""
    rows: list[list[str]] = []
    for name in names:
        if rows and name == _increment_number(rows[-1][-1]):
            rows[-1].append(name)
        else:
            rows.append([name])
    return ", ".join(f"{row[0]} ... {row[-1]}" if len(row) > 2 else ", ".join(row) for row in rows)


def _increment_number(name: str) -> str:
    """Return the name with its last number increased by 1. Empty if the name has no number."""
    match = re.fullmatch(r"(.*?)(\d+)(\D*)", name)
    return f"{match[1]}{int(match[2]) + 1}{match[3]}" if match else ""


def list_chains(above: Mapping[T, Sequence[T]]) -> tuple[tuple[T, ...], ...]:
    """Return every chain from a highest to a lowest level.

    Args:
        above: Boards directly above each board. A board without neighbours forms no chain.
    """

    def extend_upward(lower_end: tuple[T, ...]) -> Iterator[tuple[T, ...]]:
        """Yield every chain from a highest level down to and including `lower_end`."""
        uppers = [upper for upper in above[lower_end[0]] if upper not in lower_end]
        if not uppers:
            yield lower_end
        for upper in uppers:
            yield from extend_upward((upper, *lower_end))

    with_lower = {upper for uppers in above.values() for upper in uppers}
    lowest = [board for board, uppers in above.items() if uppers and board not in with_lower]
    return tuple(chain for board in lowest for chain in extend_upward((board,)))


@dataclass(frozen=True)
class ParallelChains:
    """Chains of boards whose cycles are equal at each level, so that they share one result.

    An example is a rack with one board per joint, which has a chain for each joint.

    Attributes:
        chains: Boards of each chain, the highest first. If there are several chains, they contain
            every combination of one board per level.
        cycles: Cycle of each level in ticks.
    """

    chains: tuple[tuple[str, ...], ...]
    cycles: tuple[int, ...]

    @property
    def levels(self) -> tuple[str, ...]:
        """Boards of each level as text, the highest level first."""
        return tuple(
            format_names(tuple(dict.fromkeys(boards))) for boards in zip(*self.chains, strict=True)
        )

    @property
    def bound(self) -> int:
        """Bound on the system response in ticks (eq. 3.2): n R_max for n levels."""
        return len(self.cycles) * max(self.cycles, default=0)

    @property
    def text(self) -> str:
        """All chains as one line of text, as in "trajectory > joint1 ... joint6 > arm"."""
        return " > ".join(self.levels)
