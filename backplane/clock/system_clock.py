"""The system clock as every board reads it: an integer tick on one absolute grid (eq. 3.7)."""

from __future__ import annotations

from math import inf
from time import monotonic_ns

from rack.backplane.errors import ClockError
from rack.backplane.segment import Segment
from rack.backplane.words import Run, System


class SystemClock:
    """Read access to the current tick and to the times of ticks on CLOCK_MONOTONIC."""

    def __init__(self, segment: Segment) -> None:
        self._words = segment.words
        self._clock_ns = segment.layout.clock_ns
        self.is_lockstep = bool(self._words[System.LOCKSTEP])

    @property
    def tick(self) -> int:
        """Newest tick that the clock board has begun."""
        return self._words[System.TICK]

    @property
    def is_stopped(self) -> bool:
        """True if the run is over."""
        return self._words[System.STATE] == Run.STOPPED

    def compute_tick(self) -> int:
        """Return the current tick.

        In real time it is computed from CLOCK_MONOTONIC, because the clock board may be late. In
        lockstep it is the newest tick that the clock board has begun.
        """
        if self.is_lockstep:
            return self._words[System.TICK]
        return (monotonic_ns() - self._words[System.EPOCH_NS]) // self._words[System.PERIOD_NS]

    def compute_simulated_ns(self) -> int:
        """Return the simulated time since tick 0 in ns, in real time."""
        ns = (monotonic_ns() - self._words[System.EPOCH_NS]) * self._clock_ns
        return ns // self._words[System.PERIOD_NS]

    @property
    def period_ns(self) -> int:
        """Length of a tick in real time, in ns. It depends on the speed factor of the run."""
        return self._words[System.PERIOD_NS]

    def compute_time_ns(self, tick: int) -> int:
        """Return the time of a tick, in ns of CLOCK_MONOTONIC."""
        return self._words[System.EPOCH_NS] + tick * self._words[System.PERIOD_NS]


def compute_period_ticks(
    rate_hz: float,
    clock_ns: int,
    subject: str,
    of: tuple[str, str] = ("clock", "tick"),
    fastest_hz: float = inf,
) -> int:
    """Convert a rate to a period in ticks.

    Args:
        rate_hz: Rate, rounded to four digits or more, such as 57.14 Hz for 400 Hz / 7.
        clock_ns: Length of a tick, in ns.
        subject: Words with which the error message begins, such as the name of the board.
        of: Nouns for the clock and for its tick in the error message.
        fastest_hz: Highest rate that the error message may suggest.

    Raises:
        ClockError: The rate does not divide the clock's rate. The error names the nearest rates
            that do.
    """
    clock_hz = 1e9 / clock_ns
    grid, step = of
    # The quotient is also infinite if the rate is extremely low.
    ticks = clock_hz / rate_hz if rate_hz > 0 else inf
    if ticks == inf:
        raise ClockError(
            f"{subject}: {rate_hz:g} Hz is not a rate; valid rates are {clock_hz:g} Hz divided by a"
            " whole number"
        )
    # For a rate above the clock's rate, there is only one nearest valid rate.
    nearest = {n: format_rate(clock_hz / n) for n in (int(ticks) + 1, int(ticks)) if n >= 1}
    for every in sorted(nearest, key=lambda n: abs(n - ticks)):
        if abs(ticks - every) <= 1e-6 * ticks or rate_hz == float(nearest[every]):
            return every
    rates = ", ".join(
        f"{rate} Hz (every {n} {step}{'s' if n > 1 else ''})"
        for n, rate in nearest.items()
        if float(rate) <= fastest_hz
    )
    raise ClockError(
        f"{subject}: {rate_hz:g} Hz does not divide the {clock_hz:g} Hz {grid}; nearest: {rates}"
    )


def format_rate(rate_hz: float) -> str:
    """Format a rate in Hz with the digits that `compute_period_ticks` needs to find its period."""
    return f"{rate_hz:.4g}"
