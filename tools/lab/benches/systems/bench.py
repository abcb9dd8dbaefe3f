"""Racks compared with each other: what their configs promise, and what their runs show.

Nothing is known of a rack in advance: levels, rates and bounds are read from its config, ages and
responses from its messages, by what each of them rests on.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from rack.boards.config import load, rack_timing, wire
from rack.boards.config import names as bundled
from rack.boards.config.files import CONFIGS, read
from rack.boards.config.layout import obtained_core
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.cyclictest import WakeGrid, absent_cyclictest, cyclictest, overdue
from rack.tools.lab.benches.observed import UNVIEWED, Runs, missed_share, record
from rack.tools.lab.benches.systems.figures import RealTimeFigures, SystemFigures, prediction
from rack.tools.lab.benches.systems.hold import held, hold_for
from rack.tools.lab.benches.systems.kills import kill_each, kills_s
from rack.tools.lab.benches.systems.motion import ALONE, LONGEST_S, PosesBench, poses_config
from rack.tools.lab.benches.systems.realtime import (
    ages_ms,
    board_loads,
    bus_traffic,
    cycles_in,
    plan_latencies,
)
from rack.tools.lab.benches.systems.tables import Systems
from rack.tools.live.launch import RunResult
from rack.tools.recording.cycles import cycles_of
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.analysis import core_loads
from rack.tools.timing.measured_response import system_response

LAUNCH_S = 3.0
"""About how long launching and recording a run take in addition to its time."""
LOCKSTEP_SPEED = 2.5
"""Times real time, about, on two cores."""


def systems() -> list[str]:
    """Return the bundled racks to compare: the default rack, and those that have a folder of their
    own.

    Racks of a network are not among them: they need others to work with. Of a system that is one
    rack, too, that is compared.
    """
    found = sorted(path for path in CONFIGS.glob("*/*.toml") if path.stem == path.parent.name)
    names = [path.stem if "adapter" not in read(path) else f"{path.stem}/{ALONE}" for path in found]
    known = bundled()
    return ["nasrem", *(name for name in names if name in known)]


def measure(names: Sequence[str], runs: Runs, progress: Progress) -> Systems:
    """Run every rack in real time and in lockstep, and `cyclictest` at the rate of its fastest
    boards, by turns.

    Raises `ConfigError` for a config with mistakes, before any rack runs.
    """
    absent = absent_cyclictest()
    racks = [_System(name, runs, is_compared=not absent) for name in names]
    progress.total(sum(rack.lasts_s for rack in racks))
    with TemporaryDirectory(prefix="rack-bench-") as scratch:
        figures = [
            rack.measure(Path(scratch) / str(number), progress) for number, rack in enumerate(racks)
        ]
    return Systems(tuple(figures), runs.seconds, absent)


class _System:
    """One rack, checked."""

    def __init__(self, name: str, runs: Runs, is_compared: bool) -> None:
        self._name = name
        self._runs = runs
        self._is_compared = is_compared
        own = f"systems-{os.getpid()}"
        self._lockstep = load(name, [f"name={own}", "clock.mode=lockstep", "clock.speed=1.0"])
        in_real_time = (f"name={own}", "clock.mode=realtime", "clock.speed=1.0")
        self._config = load(name, [*in_real_time, *UNVIEWED])
        self._layout = wire(self._config)
        self._timing = rack_timing(self._config, self._layout)
        self._hold = hold_for(self._config, runs.seconds)
        poses = poses_config(name)
        self._poses = None if poses is None else PosesBench(poses, own, runs.share)

    @property
    def lasts_s(self) -> float:
        """About how long measuring takes."""
        return sum(lasts_s for _, lasts_s in self._parts())

    def _parts(self) -> Iterator[tuple[str, float]]:
        """Yield what is done, and about how long each takes."""
        yield "in real time", (1 + self._is_compared) * self._runs.seconds + LAUNCH_S
        yield "killing each board", kills_s(self._layout) / LOCKSTEP_SPEED + LAUNCH_S
        if self._poses is not None:
            yield "three poses", 2.0 * LONGEST_S / LOCKSTEP_SPEED + 3 * LAUNCH_S

    def measure(self, folder: Path, progress: Progress) -> SystemFigures:
        """Run the rack, and return its figures."""
        parts = dict(self._parts())
        progress.begin(f"{self._name}: in real time")
        realtime, failure = self._in_real_time(folder / "own")
        progress.end(parts["in real time"], realtime.verdict)
        progress.begin(f"{self._name}: killing each board")
        kills = kill_each(self._lockstep, self._layout, self._runs.share)
        progress.end(parts["killing each board"], kills.failure or kills.verdict)
        poses = None
        unmoved = ""
        if self._poses is not None:
            progress.begin(f"{self._name}: three poses")
            try:
                poses = self._poses.measure(folder / "poses")
            except Failure as why:
                unmoved = str(why)
            verdict = unmoved if poses is None else poses.verdict
            progress.end(parts["three poses"], verdict)
        killed = kills.failure and f"killing each board: {kills.failure}"
        failures = [text for text in (failure, killed, unmoved) if text]
        return SystemFigures(
            rack=Path(self._name).stem,
            predicted=prediction(self._config),
            realtime=realtime,
            kills=kills,
            poses=poses,
            failure="; ".join(failures),
        )

    def _in_real_time(self, folder: Path) -> tuple[RealTimeFigures, str]:
        commands = () if self._hold is None else (self._hold,)
        config = self._config.model_copy(update={"command": (*self._config.command, *commands)})
        run, recording = record(config, self._runs.seconds, folder, self._runs.share)
        grid = self._grid()
        wakes = [cyclictest(grid)] if self._is_compared else []
        late = overdue(wakes, grid.period_ns)
        return self._figures(run, recording, late), run.failure()

    @property
    def _fastest(self) -> list[str]:
        """The boards of the shortest cycle."""
        cycles = {name: board.every for name, board in self._timing.boards.items()}
        return [name for name, every in cycles.items() if every == min(cycles.values())]

    def _grid(self) -> WakeGrid:
        boards = [self._config.board[name] for name in self._fastest]
        period_ns = self._timing.boards[self._fastest[0]].every * self._timing.tick_ns
        cores = {obtained_core(board.core) for board in boards}
        priority = max(*(board.priority for board in boards), 1)
        return WakeGrid.at(cores, 1e9 / period_ns, self._runs.seconds, priority)

    def _figures(self, run: RunResult, recording: Recording, late: float | None) -> RealTimeFigures:
        counts = [cycles_in(run, name) for name in self._fastest]
        cycles = cycles_of(recording)
        response = system_response(recording) or {"command": {}, "status": {}}
        command = response["command"]
        hold = None if self._hold is None else held(recording, self._hold)
        loads = core_loads(recording, cycles, self._timing) if cycles else {}
        board_shares = board_loads(recording, cycles, self._timing) if cycles else {}
        return RealTimeFigures(
            missed=missed_share(counts),
            late=late,
            commanded=next(iter(command.get("levels", ())), ""),
            command_bound_ms=command.get("bound_ms"),
            command_ms=command.get("measured_ms"),
            status_ms=response["status"].get("measured_ms"),
            command_age_ms=ages_ms(recording, self._timing, down=True),
            status_age_ms=ages_ms(recording, self._timing, down=False),
            hold=hold,
            plans=plan_latencies(recording, cycles),
            bus=bus_traffic(run.tasks, run.outcome.ticks, self._layout),
            loads=loads,
            board_loads=board_shares,
        )
