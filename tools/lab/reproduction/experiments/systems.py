"""Racks that model systems, next to each other: what their configs promise, and what runs
in real time show.

Nothing is known of a rack in advance: levels, rates and bounds are read from its config, responses
from its messages, by what each of them rests on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig, rack_timing, wire
from rack.boards.config import names as bundled
from rack.boards.config.files import CONFIGS, assembled
from rack.boards.config.schema import CommandConfig
from rack.boards.config.wiring import commandable
from rack.levels.operator import Operation
from rack.levels.timing.command_path import command_paths
from rack.levels.timing.forecast import Forecast
from rack.levels.timing.trace_times import Distribution
from rack.tools.lab.benches.observed import count_cycles, with_commands
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop
from rack.tools.recording.recording import Recording
from rack.tools.timing.measured_response import system_response
from rack.tools.timing.operator_response import response_of

ALONE = "one-machine"
"""The config of a system in one rack, where its main one needs other racks."""
SECONDS = 4.0
LASTS_S = 7.0
"""About how long launching, running and recording a rack take."""
AFTER_HOLD_S = 0.1
"""Simulated time left at the end of a run for statuses that show the response to a hold."""
ROUNDING_MS = 1e-6


@dataclass(frozen=True)
class SystemPrediction:
    """What a config promises, times in ms. `levels` are those of its longest response, the highest
    first."""

    levels: tuple[str, ...]
    rates_hz: tuple[float, ...]
    command_ms: float
    status_ms: float


def prediction(config: RackConfig) -> SystemPrediction:
    """Return what a config promises."""
    timing = rack_timing(config, wire(config))
    response = Forecast.of(timing).system
    return SystemPrediction(
        levels=timing.hierarchy.levels,
        rates_hz=tuple(1e9 / (every * timing.clock_ns) for every in timing.hierarchy.cycles),
        command_ms=response.command_ms,
        status_ms=response.status_ms,
    )


@dataclass(frozen=True)
class HoldResponse:
    """The response to an operator's hold, from giving it to the end of the lowest level's cycle
    that rests on it, ms of simulated time.

    `longest_ms` is the longest on the grid; `measured_ms` is None unless it was acted on.
    """

    level: str
    measured_ms: float | None
    longest_ms: float

    @property
    def beyond(self) -> bool:
        """Whether it took longer than the longest on the grid."""
        return self.measured_ms is not None and self.measured_ms > self.longest_ms + ROUNDING_MS


@dataclass(frozen=True)
class RealTimeFigures:
    """What a run in real time has shown; times in ms of simulated time.

    `missed` is the share of the cycles of the fastest boards. `command_ms` and `status_ms` are the
    response measured down the hierarchy, and up. None: the rack has no such thing.
    """

    missed: float
    command_ms: Distribution | None
    status_ms: Distribution | None
    hold: HoldResponse | None


@dataclass(frozen=True)
class SystemFigures:
    """One rack: what its config promises, and what its run has shown."""

    rack: str
    predicted: SystemPrediction
    realtime: RealTimeFigures
    failure: str

    @property
    def worked(self) -> bool:
        """Whether its run worked."""
        return not self.failure


def systems() -> list[str]:
    """Return the bundled racks to compare: the default rack, and those that have a folder of their
    own.

    Racks of a network are not among them: they need others to work with. Of a system that is one
    rack, too, that is compared.
    """
    found = sorted(path for path in CONFIGS.glob("*/*.toml") if path.stem == path.parent.name)
    names = [
        path.stem if "adapter" not in assembled(path, (), None) else f"{path.stem}/{ALONE}"
        for path in found
    ]
    known = bundled()
    return ["nasrem", *(name for name in names if name in known)]


def system_experiment(name: str) -> Experiment[SystemFigures]:
    """Return the figures of one rack."""
    label = f"system-{name.replace('/', '-')}"
    about = f"{name} next to the other systems"
    return Experiment(label, about, LASTS_S, SystemFigures, partial(_run, name, label))


def _run(name: str, label: str, workshop: Workshop) -> SystemFigures:
    config = workshop.config(name, ["clock.mode=realtime", "clock.speed=1.0"])
    hold = hold_for(config, SECONDS)
    commanded = with_commands(config, [] if hold is None else [hold])
    result, recording = workshop.run(label, commanded, SECONDS)
    shortest = min(task.every for task in recording.layout.tasks if task.role == "executor")
    fastest = [
        task.name
        for task in recording.layout.tasks
        if task.role == "executor" and task.every == shortest
    ]
    response = system_response(recording) or {"command": {}, "status": {}}
    return SystemFigures(
        rack=name,
        predicted=prediction(config),
        realtime=RealTimeFigures(
            missed=count_cycles(result.tasks[task] for task in fastest).share,
            command_ms=response["command"].get("measured_ms"),
            status_ms=response["status"].get("measured_ms"),
            hold=None if hold is None else _held(recording, hold),
        ),
        failure=result.failure(),
    )


def hold_for(config: RackConfig, seconds: float) -> CommandConfig | None:
    """Return a hold of the highest level that takes one and shows a response within the run; None
    if there is none."""
    layout = wire(config)
    taken = commandable(config)
    paths = command_paths(rack_timing(config, layout), layout).values()
    ticks, after = (round(time_s * 1e9 / config.clock_ns) for time_s in (seconds, AFTER_HOLD_S))
    for path in sorted(paths, key=lambda path: (len(path.levels), path.longest), reverse=True):
        last = ticks - path.longest - after
        takes_hold = Operation.HOLD in taken[path.levels[0]]
        if last > 0 and takes_hold and _shows_command(layout, path.levels[-1]):
            return CommandConfig(level=path.levels[0], what="hold", tick=min(last, ticks // 2))
    return None


def _shows_command(layout: Layout, level: str) -> bool:
    """Return whether a level's status shows on which command its work rests."""
    fields = [box.fields for box in layout.mailboxes if box.name == f"{level}.status"]
    return any(field.name == "operator" for each in fields for field in each)


def _held(recording: Recording, hold: CommandConfig) -> HoldResponse | None:
    response = response_of(recording)
    if response is None:
        return None
    for command in response.commands:
        # The config may have commands of its own.
        if (command.level, command.given) == (hold.level, hold.tick):
            acts = command.acts is not None
            measured_ms = response.ticks(command) * response.tick_ms if acts else None
            longest_ms = response.paths[hold.level].longest * response.tick_ms
            return HoldResponse(hold.level, measured_ms, longest_ms)
    return None


SYSTEMS = tuple(system_experiment(name) for name in systems())
"""Every rack that models a system, NASREM first."""
