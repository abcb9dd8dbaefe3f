"""Racks compared with each other: what their configs promise, and what one short run each in both modes shows.

Nothing is known of a rack in advance: levels, rates and bounds are read from its config, ages and responses from its
messages, by what each of them rests on.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig, load, rack_timing, wire
from rack.boards.config.commands import commandable
from rack.boards.config.files import CONFIGS
from rack.boards.config.layout import obtained_core
from rack.boards.config.schema import CommandConfig
from rack.levels.operator import Operation
from rack.levels.timing.forecast import Forecast
from rack.levels.timing.rack import RackTiming
from rack.levels.timing.system_response import CommandPath, command_paths, mailboxes_along
from rack.levels.timing.trace_times import Distribution, distribution, newest_visible
from rack.tools.analysis.analysis import core_loads
from rack.tools.benches.cyclictest import WakeGrid, absent_cyclictest, cyclictest, overdue
from rack.tools.benches.observed import CycleCount, Runs, missed_share
from rack.tools.benches.system_figures import HoldResponse, SystemFigures, SystemPrediction, Systems
from rack.tools.console.progress import Progress
from rack.tools.runs.cycles import cycles_of
from rack.tools.runs.display import Display
from rack.tools.runs.launch import RunResult, run_rack
from rack.tools.runs.measured_response import system_response
from rack.tools.runs.recording import Recording
from rack.tools.timing.operator_response import AnsweredCommand, OperatorResponse, response_of

LAUNCH_S = 4.0
"""About how long launching and recording a run take in addition to its time."""
BEFORE_HOLD = 0.5
"""Part of a run after which the operator commands the hold, if the response to it still fits."""
AFTER_HOLD_S = 0.1
"""Simulated time left at the end for statuses that show the response."""


def systems() -> list[str]:
    """Return the bundled racks to compare: the default rack, and those that have a folder of their own."""
    return ["nasrem", *sorted(path.stem for path in CONFIGS.glob("*/*.toml") if path.stem == path.parent.name)]


def measure(names: Sequence[str], runs: Runs, progress: Progress) -> Systems:
    """Run every rack in lockstep and in real time, and `cyclictest` at the rate of its fastest boards, by turns.

    Raises `ConfigError` for a config with mistakes, before any rack runs.
    """
    absent = absent_cyclictest()
    racks = [_System(name, runs, is_compared=absent is None) for name in names]
    progress.total(sum(rack.lasts_s for rack in racks))
    figures = []
    with TemporaryDirectory(prefix="rack-bench-") as scratch:
        for number, rack in enumerate(racks):
            figures.append(rack.measure(Path(scratch) / str(number), progress))
    return Systems(tuple(figures), runs.seconds, absent)


@dataclass(frozen=True)
class _Ran:
    """The runs of one rack. `late_us` is the lateness of `cyclictest`, shape (n,), None if it is absent."""

    lockstep: RunResult
    realtime: RunResult
    recording: Recording
    late_us: np.ndarray | None


class _System:
    """One rack, checked."""

    def __init__(self, name: str, runs: Runs, is_compared: bool) -> None:
        self._name, self._runs, self._is_compared = name, runs, is_compared
        own = f"name=systems-{os.getpid()}"
        self._lockstep = load(name, [own, "clock.mode=lockstep", "clock.speed=1.0"])
        self._config = load(name, [own, "clock.mode=realtime", "clock.speed=1.0"])
        self._layout = wire(self._config)
        self._timing = rack_timing(self._config, self._layout)
        self._hold = hold_for(self._config, self._timing, self._layout, runs.seconds)

    @property
    def lasts_s(self) -> float:
        """About how long measuring takes."""
        return (2 + self._is_compared) * self._runs.seconds + 2 * LAUNCH_S

    def measure(self, folder: Path, progress: Progress) -> SystemFigures:
        """Run the rack, and return its figures."""
        progress.begin(f"{self._name}: in lockstep")
        seconds = self._runs.seconds
        lockstep = run_rack(self._lockstep, seconds, None, Display())
        progress.begin(f"{self._name}: in real time")
        commands = () if self._hold is None else (self._hold,)
        config = self._config.model_copy(update={"command": (*self._config.command, *commands)})
        realtime = run_rack(config, seconds, folder, Display(), share=self._runs.share)
        late_us = cyclictest(self._grid()) if self._is_compared else None
        found = self._figures(_Ran(lockstep, realtime, Recording(folder), late_us))
        progress.end(self.lasts_s, found.verdict, ())
        return found

    @property
    def _fastest(self) -> list[str]:
        """The boards of the shortest cycle."""
        cycles = {name: board.every for name, board in self._timing.boards.items()}
        return [name for name, every in cycles.items() if every == min(cycles.values())]

    def _grid(self) -> WakeGrid:
        boards = [self._config.board[name] for name in self._fastest]
        period_ns = self._timing.boards[self._fastest[0]].every * self._timing.tick_ns
        return WakeGrid(
            cores=tuple(sorted({obtained_core(board.core) for board in boards})),
            period_ns=period_ns,
            wakes=max(1, round(self._runs.seconds * 1e9 / period_ns)),
            priority=max(*(board.priority for board in boards), 1),
        )

    def _figures(self, ran: _Ran) -> SystemFigures:
        counts = [cycles_in(ran.realtime, self._layout, name) for name in self._fastest]
        ended = [run for run in (ran.lockstep, ran.realtime) if not run.worked]
        cycles = cycles_of(ran.recording)
        response = system_response(ran.recording)
        return SystemFigures(
            rack=Path(self._name).stem,
            predicted=prediction(self._config, self._timing, self._layout),
            lockstep_speed=ran.lockstep.outcome.ticks * self._config.clock_ns * 1e-9 / ran.lockstep.wall_s,
            missed=missed_share(counts),
            late=None if ran.late_us is None else overdue(ran.late_us, self._grid().period_ns),
            loads=core_loads(ran.recording, cycles, self._timing) if cycles else {},
            commanded="" if response is None else next(iter(response["command"]["levels"]), ""),
            command_ms=None if response is None else response["command"]["measured_ms"],
            status_ms=None if response is None else response["status"]["measured_ms"],
            command_age_ms=ages_ms(ran.recording, self._timing, down=True),
            status_age_ms=ages_ms(ran.recording, self._timing, down=False),
            hold=None if self._hold is None else held(ran.recording, self._hold),
            failure="; ".join(run.failure() for run in ended),
        )


def hold_for(config: RackConfig, timing: RackTiming, layout: Layout, seconds: float) -> CommandConfig | None:
    """Return a hold of the highest level that takes one and responds within the run; None: there is none."""
    taken = commandable(config)
    paths = [
        path
        for level, path in command_paths(timing, layout).items()
        if Operation.HOLD in taken[level] and _shows(layout, path)
    ]
    ticks, after = (round(time_s * 1e9 / config.clock_ns) for time_s in (seconds, AFTER_HOLD_S))
    last = {path: ticks - path.longest - after for path in paths}
    fitting = [path for path in paths if last[path] > 0]
    if not fitting:
        return None
    path = max(fitting, key=lambda path: (len(path.levels), path.longest))
    return CommandConfig(level=path.levels[0], what="hold", tick=min(last[path], round(BEFORE_HOLD * ticks)))


def _shows(layout: Layout, path: CommandPath) -> bool:
    """Return whether the lowest level on a path shows on which command its work rests."""
    status = f"{path.levels[-1]}.status"
    boxes = [box for box in layout.mailboxes if box.name == status]
    return any(field.name == "operator" for box in boxes for field in box.fields)


def held(recording: Recording, hold: CommandConfig) -> HoldResponse | None:
    """Return the response to the hold of a run; None if the recording lacks it."""
    response = response_of(recording)
    if response is None:
        return None
    # The config may have commands of its own.
    given = [one for one in response.commands if (one.level, one.given) == (hold.level, hold.tick)]
    return next((_response(response, one) for one in given), None)


def _response(response: OperatorResponse, command: AnsweredCommand) -> HoldResponse:
    measured = None if command.acts is None else response.ticks(command) * response.tick_ms
    longest_ms = response.paths[command.level].longest * response.tick_ms
    return HoldResponse(command.level, command.fate, measured, longest_ms, command.wall_ms)


def prediction(config: RackConfig, timing: RackTiming, layout: Layout) -> SystemPrediction:
    """Return what a config promises."""
    forecast, hierarchy = Forecast.of(timing), timing.hierarchy
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


def cycles_in(run: RunResult, layout: Layout, board: str) -> CycleCount:
    """Count the cycles of a board in a run: those missed or skipped, and those due."""
    counted, due = run.tasks[board], -(-run.outcome.ticks // layout.task(board).every)
    return CycleCount(min(due, counted["missed"] + counted["skipped"]), due)


def ages_ms(recording: Recording, timing: RackTiming, down: bool) -> Distribution | None:
    """Return the age of commands in the cycles of the lowest levels, or of their statuses in those above, ms.

    An age is the time since the release that wrote the message. None if there is no such message.
    """
    pairs = dict.fromkeys(chain[-2:] if down else chain[:-3:-1] for chain in timing.hierarchy.chains)
    found = [ages for writer, reader in pairs for ages in _ages(recording, writer, reader)]
    return distribution(np.concatenate(found) * timing.clock_ns * 1e-6) if found else None


def _ages(recording: Recording, writer: str, reader: str) -> Iterator[np.ndarray]:
    """Yield the ages in ticks of what one board has of another, cycle by cycle."""
    cycles: np.ndarray = recording.cycles[reader]["tick"]
    for box in mailboxes_along(recording.layout, (writer, reader)):
        made, visible_at = (recording.signal(box.name, name) for name in ("tick", "visible_at"))
        grid = recording.layout.read_grid(box, reader)
        # Between two reads the message of the last one grows older.
        since = (cycles - grid.phase) % grid.every
        newest = newest_visible(cycles - since, visible_at)
        yield cycles[newest >= 0] - made[newest[newest >= 0]]
