"""An operator's hold of the highest level of a rack that takes one, and the torque that rests on
it."""

from __future__ import annotations

from dataclasses import dataclass

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig, rack_timing, wire
from rack.boards.config.schema import CommandConfig
from rack.boards.config.wiring import commandable
from rack.levels.operator import Operation
from rack.levels.timing.command_path import CommandPath, command_paths
from rack.tools.recording.recording import Recording
from rack.tools.timing.operator_response import AnsweredCommand, OperatorResponse, response_of

BEFORE_HOLD = 0.5
"""Part of a run after which the operator commands the hold, if the response to it still fits."""
AFTER_HOLD_S = 0.1
"""Simulated time left at the end for statuses that show the response."""
ROUNDING_MS = 1e-6


@dataclass(frozen=True)
class HoldResponse:
    """The response to an operator's hold, from giving it to the end of the lowest level's cycle
    that rests on it, ms.

    `measured_ms` and `longest_ms`, the longest on the grid, are simulated time, `wall_ms` is the
    wall clock's. `fate` is what became of the command; unless it was acted on, nothing was
    measured.
    """

    level: str
    fate: str
    measured_ms: float | None
    longest_ms: float
    wall_ms: float | None

    @property
    def beyond(self) -> bool:
        """Whether it took longer than the longest on the grid."""
        return self.measured_ms is not None and self.measured_ms > self.longest_ms + ROUNDING_MS


def hold_paths(config: RackConfig) -> list[CommandPath]:
    """Return the paths of a hold from every level that takes one and shows the response, the
    longest first."""
    layout = wire(config)
    taken = commandable(config)
    paths = [
        path
        for level, path in command_paths(rack_timing(config, layout), layout).items()
        if Operation.HOLD in taken[level] and _shows(layout, path)
    ]
    return sorted(paths, key=lambda path: (len(path.levels), path.longest), reverse=True)


def hold_for(config: RackConfig, seconds: float) -> CommandConfig | None:
    """Return a hold of the highest level that takes one and responds within the run; None: there is
    none."""
    ticks, after = (round(time_s * 1e9 / config.clock_ns) for time_s in (seconds, AFTER_HOLD_S))
    for path in hold_paths(config):
        if (last := ticks - path.longest - after) > 0:
            return CommandConfig(
                level=path.levels[0], what="hold", tick=min(last, round(BEFORE_HOLD * ticks))
            )
    return None


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
