"""What a config promises, before any run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig
from rack.levels.timing.forecast import Forecast
from rack.levels.timing.rack import RackTiming


@dataclass(frozen=True)
class SystemPrediction:
    """What a config promises, times in ms. `levels` are those of its longest response, the highest
    first.

    `boards` are the slots that it takes besides the clock's, `hosts` its boards without real time;
    `processes` are those that it starts. `fits` is None without a budget; `loads` are by core.
    """

    levels: tuple[str, ...]
    boards: int
    hosts: int
    processes: int
    rates_hz: tuple[float, ...]
    longest_cycle_ms: float
    bound_ms: float
    sum_ms: float
    command_ms: float
    status_ms: float
    loads: Mapping[int, float]
    fits: bool | None


def prediction(config: RackConfig, timing: RackTiming, layout: Layout) -> SystemPrediction:
    """Return what a config promises."""
    forecast = Forecast.of(timing)
    hierarchy = timing.hierarchy
    slots = {task.slot for task in layout.tasks}
    started = [host for host in config.host.values() if not host.external]
    rates = (1e9 / (every * timing.clock_ns) for every in hierarchy.cycles)
    return SystemPrediction(
        levels=hierarchy.levels,
        boards=len(slots),
        hosts=len(config.host),
        processes=len(layout.tasks) + len(started) + 1,  # the clock's
        rates_hz=tuple(rates),
        longest_cycle_ms=max(hierarchy.cycles, default=0) * timing.clock_ns * 1e-6,
        bound_ms=forecast.system.bound_eq_3_2_ms,
        sum_ms=forecast.system.sum_eq_3_3_ms,
        command_ms=forecast.system.command_ms,
        status_ms=forecast.system.status_ms,
        loads=dict(sorted(forecast.loads.items())),
        fits=forecast.holds if forecast.levels else None,
    )
