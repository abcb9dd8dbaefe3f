"""The figures by which racks are compared, as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from rack.levels.timing.trace_times import Distribution
from rack.tools.lab.benches.cyclictest import MissesBeyond
from rack.tools.lab.benches.systems.hold import HoldResponse
from rack.tools.lab.benches.systems.kills import KilledBoards
from rack.tools.lab.benches.systems.motion import PosesRun
from rack.tools.lab.benches.systems.prediction import SystemPrediction
from rack.tools.lab.benches.systems.realtime import BusTraffic, PlanLatency


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
