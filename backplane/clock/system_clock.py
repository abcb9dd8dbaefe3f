"""The system clock as every board reads it: an integer tick on one absolute grid (eq. 3.7)."""

from __future__ import annotations

from math import inf
from time import monotonic_ns

from rack.backplane.errors import ClockError
from rack.backplane.segment import Segment
from rack.backplane.words import Run, System

# Plain integers for the hot path.
_STATE, _TICK, _EPOCH, _PERIOD, _LOCKSTEP = (
    int(w) for w in (System.STATE, System.TICK, System.EPOCH_NS, System.PERIOD_NS, System.LOCKSTEP)
)


class SystemClock:
    """Read access to the clock: the current tick, and the times of ticks on CLOCK_MONOTONIC."""

    def __init__(self, segment: Segment) -> None:
        self._words = segment.words
        self.is_lockstep = bool(self._words[_LOCKSTEP])

    @property
    def tick(self) -> int:
        """The newest tick of the clock board."""
        return self._words[_TICK]

    @property
    def is_stopped(self) -> bool:
        """True when the run is over."""
        return self._words[_STATE] == Run.STOPPED

    def now(self) -> int:
        """Return the current tick: in real time by the grid, as the clock board may be late; else
        the newest tick."""
        if self.is_lockstep:
            return self._words[_TICK]
        return (monotonic_ns() - self._words[_EPOCH]) // self._words[_PERIOD]

    @property
    def period_ns(self) -> int:
        """Time from tick to tick, in ns of the wall clock."""
        return self._words[_PERIOD]

    def time_of(self, tick: int) -> int:
        """Return the CLOCK_MONOTONIC time of a tick, in ns."""
        return self._words[_EPOCH] + tick * self._words[_PERIOD]


def ticks_of(
    rate_hz: float, clock_ns: int, what: str, of: tuple[str, str] = ("clock", "tick")
) -> int:
    """Return the period, in ticks, of a rate. Raises `ClockError` with the nearest rates when off
    the grid.

    `of`: the text's words for the grid and for one step of it.
    """
    clock_hz = 1e9 / clock_ns
    grid, step = of
    # Infinite, too, for a rate so low that the quotient has no number.
    ticks = clock_hz / rate_hz if rate_hz > 0 else inf
    if ticks == inf:
        raise ClockError(
            f"{what}: {rate_hz:g} Hz is not a rate; permitted: {clock_hz:g} Hz divided by a whole"
            " number"
        )
    every = round(ticks)
    if every >= 1 and abs(ticks - every) <= 1e-6 * ticks:
        return every
    # Above the clock's own rate there is only one neighbour.
    nearest = [n for n in (int(ticks) + 1, int(ticks)) if n >= 1]
    rates = ", ".join(
        f"{clock_hz / n:.4g} Hz (every {n} {step}{'s' if n > 1 else ''})" for n in nearest
    )
    raise ClockError(
        f"{what}: {rate_hz:g} Hz does not divide the {clock_hz:g} Hz {grid}; nearest: {rates}"
    )
