"""Why a segment cannot be done."""

from __future__ import annotations

from typing import NamedTuple

from rack.levels.messages import Error


class Fault(NamedTuple):
    """Code and one readable line; with TOO_LATE, `earliest` is the simulated time, in s, that could be met."""

    code: Error
    reason: str
    earliest: float = 0.0
