"""The figures by which racks are compared, as plain data: those that a config promises before any
run, and those of runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from rack.boards.config import RackConfig, rack_timing, wire
from rack.levels.timing.forecast import Forecast
from rack.levels.timing.trace_times import Distribution
from rack.tools.lab.benches.cyclictest import MissesBeyond
from rack.tools.lab.benches.systems.hold import HoldResponse
from rack.tools.lab.benches.systems.kills import KilledBoards
from rack.tools.lab.benches.systems.motion import PosesRun
from rack.tools.lab.benches.systems.realtime import BusTraffic, PlanLatency


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


def prediction(config: RackConfig) -> SystemPrediction:
    """Return what a config promises."""
    layout = wire(config)
    timing = rack_timing(config, layout)
    forecast = Forecast.of(timing)
    hierarchy = timing.hierarchy
    slots = {task.slot for task in layout.tasks}
    started = [host for host in config.host.values() if not host.external]
    rates = (1e9 / (every * timing.clock_ns) for every in hierarchy.cycles)
    fits = forecast.holds if forecast.levels else None
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
        fits=fits,
    )


@dataclass(frozen=True)
class RealTimeFigures(MissesBeyond):
    """What a run in real time has shown; times in ms of simulated time.

    `missed` is the share of the cycles of the fastest boards. `command_ms` and `status_ms` are the
    response measured down the hierarchy from `commanded`, which is below a queue if there is one,
    and up; `command_bound_ms` is the longest that the grid permits from there. Ages are those of
    commands when the lowest level reads them, and of its statuses when they are read above. None:
    the rack has no such thing. `loads` are processor time by core, `board_loads` by board, both as
    parts of one core; host boards are not traced.
    """

    missed: float
    late: float | None
    commanded: str
    command_bound_ms: float | None
    command_ms: Distribution | None
    status_ms: Distribution | None
    command_age_ms: Distribution | None
    status_age_ms: Distribution | None
    hold: HoldResponse | None
    plans: tuple[PlanLatency, ...]
    bus: Mapping[str, BusTraffic]
    loads: Mapping[int, float]
    board_loads: Mapping[str, float]

    @property
    def verdict(self) -> str:
        """Whether its rate was held, in words."""
        return "held" if self.held else f"{100 * self.beyond:.2f} % missed beyond cyclictest"


@dataclass(frozen=True)
class SystemFigures:
    """One rack: what its config promises, and what its runs have shown. `poses` is None without a
    PUMA to move."""

    DERIVED: ClassVar = ("worked",)

    rack: str
    predicted: SystemPrediction
    realtime: RealTimeFigures
    kills: KilledBoards
    poses: PosesRun | None
    failure: str

    @property
    def worked(self) -> bool:
        """Whether all its runs worked."""
        return not self.failure
