"""Mistakes in `[schedule]`: frames that are off the clock's grid, and boards whose cycles do not fit in them."""

from __future__ import annotations

from collections.abc import Iterator

from rack.backplane.errors import ClockError
from rack.boards.config.schema import RackConfig, ScheduleConfig
from rack.boards.errors import Mistake
from rack.levels.timing.rack import CyclicSchedule

LONGEST_MAJOR = 10_000
"""Longest major frame, ticks: the timing model computes two of them."""


def frames(table: ScheduleConfig, clock_ns: int) -> CyclicSchedule:
    """Return the frames, rounded to ticks."""
    return CyclicSchedule(*(round(ms * 1e6 / clock_ns) for ms in (table.minor_ms, table.major_ms)))


def schedule_mistakes(config: RackConfig) -> Iterator[Mistake]:
    """Yield the mistakes of a static schedule; those of its boards only if its frames are right."""
    table = config.schedule
    if table is None:
        return
    found = list(_of_frames(table, config.clock_ns))
    yield from found or _of_boards(config, table)


def _of_frames(table: ScheduleConfig, clock_ns: int) -> Iterator[Mistake]:
    tick_ms = clock_ns * 1e-6
    minor, major = frames(table, clock_ns)
    if minor < 1 or abs(minor * tick_ms - table.minor_ms) > 1e-6 * tick_ms:
        why = f"not a whole number of ticks of {tick_ms:g} ms; nearest: {_nearest(table.minor_ms, tick_ms)} ms"
        yield Mistake("schedule.minor_ms", table.minor_ms, why)
    elif major % minor or not major or abs(major * tick_ms - table.major_ms) > 1e-6 * tick_ms:
        near = _nearest(table.major_ms, table.minor_ms)
        why = f"not a multiple of minor_ms, {table.minor_ms:g} ms; nearest: {near} ms"
        yield Mistake("schedule.major_ms", table.major_ms, why)
    elif major > LONGEST_MAJOR:
        why = f"{major} ticks; permitted: up to {LONGEST_MAJOR}, {LONGEST_MAJOR * tick_ms:g} ms"
        yield Mistake("schedule.major_ms", table.major_ms, why)


def _nearest(value: float, step: float) -> str:
    """Return the multiples of `step` next to a value that is none."""
    below = int(value / step)
    return " or ".join(f"{number * step:g}" for number in (below, below + 1) if number)


def _of_boards(config: RackConfig, table: ScheduleConfig) -> Iterator[Mistake]:
    (minor, major), tick_ms = frames(table, config.clock_ns), config.clock_ns * 1e-6
    fitting = [minor * number for number in range(1, major // minor + 1) if major % (minor * number) == 0]
    for name, board in config.board.items():
        try:
            every = config.every(name)
        except ClockError:
            continue
        if every in fitting:
            continue
        key = "rate_hz" if board.every is None else "every"
        below, above = [cycle for cycle in fitting if cycle < every], [cycle for cycle in fitting if cycle > every]
        rates = " or ".join(
            f"{cycle * tick_ms:g} ms, {f'{1e3 / (cycle * tick_ms):g} Hz' if key == 'rate_hz' else f'every {cycle}'}"
            for cycle in (*below[-1:], *above[:1])
        )
        why = (
            f"a cycle of {every * tick_ms:g} ms does not fit the schedule, a multiple of the minor frame, "
            f"{table.minor_ms:g} ms, that divides the major one, {table.major_ms:g} ms; nearest: {rates}"
        )
        yield Mistake(f"board.{name}.{key}", getattr(board, key), why)
