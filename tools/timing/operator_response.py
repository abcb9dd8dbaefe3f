"""The response of a recorded run to its operator.

It lasts from giving a command to the first torque that depends on it. Causality is measured, not
inferred: every command and status carries the serial of the newest operator command on which it
depends.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from rack.boards.config import build_rack_timing
from rack.boards.timing.command_path import CommandPath, find_command_paths
from rack.boards.timing.trace_times import compute_distribution
from rack.levels.operator import Answer, Operation
from rack.tools.console.answer import Document, Failure, print_json, write_json
from rack.tools.console.pictures import NO_PICTURES, can_draw, list_picture_paths, open_figure
from rack.tools.console.tables import Blocks, TextTable, format_decimal, print_blocks
from rack.tools.recording.recording import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Fate = Literal["acted on", "refused", "superseded", "run over"]
# Colours of Okabe and Ito's palette, which colour-blind readers can distinguish.
MEASURED = "#0072b2"
GRID = "#009e73"
SUM = "#e69f00"
BOUND = "#d55e00"
TABLE_COLUMNS = {
    "min": "min_ms",
    "median": "median_ms",
    "max": "max_ms",
    "on grid": "longest_ms",
    "from reading": "max_from_reading_ms",
    "eq. 3.3": "sum_eq_3_3_ms",
    "eq. 3.2": "bound_eq_3_2_ms",
}
"""Columns of the table, and the figure of a level that each of them shows."""
HISTOGRAM_BARS = 40
"""Number of histogram bars up to the longest response and the bounds."""


@dataclass(frozen=True)
class AnsweredCommand:
    """An operator command and its effect. Times are in ticks, except `wall_ms`.

    Attributes:
        serial: Serial of the command.
        level: Level that was commanded.
        what: Name of the operation.
        given: Tick at which it was given.
        sampled: Release at which the level reads it.
        predicted: Predicted release of the first cycle whose torque depends on it.
        acts: Measured release of this cycle. None if no cycle depends on this very command,
            because it was refused, a newer one overtook it, or the run ended first.
        fate: Outcome of the command.
        wall_ms: Response by the wall clock, from giving the command to writing the status of that
            cycle, ms. None in lockstep.
        ticks: Measured response. None without `acts`.
    """

    serial: int
    level: str
    what: str
    given: int
    sampled: int
    predicted: int
    acts: int | None
    fate: Fate
    wall_ms: float | None = None
    ticks: int | None = None


@dataclass(frozen=True)
class OperatorResponse:
    """The response of a run to its operator commands.

    Attributes:
        tick_ms: Simulated time of a tick, ms.
        lockstep: Whether the run was in lockstep.
        paths: Path of commands for every level that was commanded.
        commands: All commands.
    """

    tick_ms: float
    lockstep: bool
    paths: dict[str, CommandPath]
    commands: tuple[AnsweredCommand, ...]

    @property
    def measured_commands(self) -> list[AnsweredCommand]:
        """Commands on which a torque depends."""
        return [command for command in self.commands if command.ticks is not None]

    @property
    def commands_beyond_bound(self) -> list[AnsweredCommand]:
        """Commands whose response exceeded a bound.

        The bounds are the longest response on the grid, and the bound of equation 3.2, which counts
        from the release that reads the command.
        """
        return [
            c
            for c in self.commands
            if c.ticks is not None
            and (
                c.ticks > self.paths[c.level].longest
                or c.ticks - (c.sampled - c.given) > self.paths[c.level].bound_eq_3_2
            )
        ]

    @property
    def mispredicted_commands(self) -> list[AnsweredCommand]:
        """Commands that did not take effect at the predicted tick.

        Only paths with an exact prediction are compared.
        """
        exact = [c for c in self.measured_commands if self.paths[c.level].is_exact]
        return [command for command in exact if command.acts != command.predicted]

    @property
    def is_within_bounds(self) -> bool:
        """Whether all responses are within bounds and, in lockstep, at the predicted ticks."""
        return not self.commands_beyond_bound and not (self.lockstep and self.mispredicted_commands)

    def build_rows(self) -> Iterator[Document]:
        """Yield the figures of every level that was commanded, in ms of simulated time."""
        for level, path in self.paths.items():
            commands = [c for c in self.measured_commands if c.level == level]
            ms = np.array([c.ticks for c in commands]) * self.tick_ms
            waits_ms = np.array([c.sampled - c.given for c in commands]) * self.tick_ms
            none = dict.fromkeys(("min", "p50", "max"))
            stats = compute_distribution(ms) or none
            yield {
                "level": level,
                "commands": len(commands),
                "min_ms": stats["min"],
                "median_ms": stats["p50"],
                "max_ms": stats["max"],
                "max_from_reading_ms": (compute_distribution(ms - waits_ms) or none)["max"],
                "longest_ms": path.longest * self.tick_ms,
                "sum_eq_3_3_ms": path.sum_eq_3_3 * self.tick_ms,
                "bound_eq_3_2_ms": path.bound_eq_3_2 * self.tick_ms,
                "beyond": sum(c.level == level for c in self.commands_beyond_bound),
                "off_prediction": sum(c.level == level for c in self.mispredicted_commands),
            }

    def to_document(self) -> Document:
        """Convert the response to plain data."""
        return {
            "lockstep": self.lockstep,
            "tick_ms": self.tick_ms,
            "commands": len(self.commands),
            "measured": len(self.measured_commands),
            "beyond": len(self.commands_beyond_bound),
            "off_prediction": len(self.mispredicted_commands),
            "levels": [*self.build_rows()],
            "each": [*map(asdict, self.commands)],
        }

    def format_blocks(self) -> Blocks:
        """Yield the figures as text for the terminal."""
        yield (
            f"response to {len(self.measured_commands)} operator commands, ms of simulated time:"
            " from giving a command, and"
        )
        yield "from the release that reads it, to the end of the cycle whose torque rests on it"
        rows = [
            {
                "given to": row["level"],
                "commands": row["commands"],
                **{head: format_decimal(row[key], 1) for head, key in TABLE_COLUMNS.items()},
                "beyond": row["beyond"],
                "off": row["off_prediction"],
            }
            for row in self.build_rows()
        ]
        yield TextTable(rows, ("min", "eq. 3.3", "median"))
        if others := [command for command in self.commands if command.acts is None]:
            yield (
                f"not measured: {', '.join(f'{c.serial} to {c.level} ({c.fate})' for c in others)}"
            )
        for command in self.mispredicted_commands:
            late = (command.acts or 0) - command.predicted
            yield (
                f"command {command.serial} to {command.level}, given at tick {command.given}:"
                f" {late:+d} ticks"
            )


def measure_response(recording: Recording) -> OperatorResponse | None:
    """Measure the response of a run. None if no operator commanded a level of its hierarchy."""
    config = recording.rack_config
    layout = recording.layout
    known = find_command_paths(build_rack_timing(config, layout), layout)
    paths = {
        level: path for level, path in known.items() if f"{level}.operator" in recording.mailboxes
    }
    if not paths:
        return None
    lockstep = config.is_lockstep
    answered = [
        command
        for level, path in paths.items()
        for command in _find_answers(recording, level, path, lockstep)
    ]
    answered.sort(key=lambda command: command.serial)
    return OperatorResponse(layout.clock_ns * 1e-6, lockstep, paths, tuple(answered))


def _find_answers(
    recording: Recording, level: str, path: CommandPath, lockstep: bool
) -> Iterator[AnsweredCommand]:
    """Yield each command to a level, with the first cycle of the lowest level that depends on it.

    Args:
        recording: Recording of the run.
        level: Level that was commanded.
        path: Path of a command from this level to the lowest one.
        lockstep: Whether the run was in lockstep.
    """
    box = f"{level}.operator"
    # If the clock board died while it gave a command, the command may have been given twice. Only
    # the first one counts.
    serials, rows = np.unique(recording.read_signal(box, "id"), return_index=True)
    whats, given, visible, stamps = (
        recording.read_signal(box, n)[rows] for n in ("what", "tick", "visible_at", "stamp_ns")
    )
    orders, answers = (recording.read_signal(f"{level}.status", n) for n in ("order", "answer"))
    refused = set(orders[answers == Answer.REFUSED].tolist())
    basis, ticks, written = (
        recording.read_signal(f"{path.levels[-1]}.status", n)
        for n in ("operator", "tick", "stamp_ns")
    )
    for serial, what, tick, seen, stamp in zip(serials, whats, given, visible, stamps, strict=True):
        resting_rows = np.flatnonzero(basis >= serial)
        fate: Fate = "run over"
        acts = wall_ms = None
        if int(serial) in refused:
            fate = "refused"
        elif len(resting_rows) and basis[resting_rows[0]] != serial:
            fate = "superseded"
        elif len(resting_rows):
            fate = "acted on"
            acts = int(ticks[resting_rows[0]])
            wall_ms = round((int(written[resting_rows[0]]) - int(stamp)) * 1e-6, 6)
        yield AnsweredCommand(
            serial=int(serial),
            level=level,
            what=Operation(int(what)).name.lower(),
            given=int(tick),
            sampled=path.find_reading_release(int(seen)),
            predicted=path.find_acting_release(int(seen)),
            acts=acts,
            fate=fate,
            wall_ms=None if lockstep else wall_ms,
            ticks=None if acts is None else acts + path.cycles[-1] - int(tick),
        )


def show_response(recording: Recording, folder: Path, as_json: bool) -> bool:
    """Print the response of a run, and write response.json and its pictures.

    Args:
        recording: Recording of the run.
        folder: Folder for the files.
        as_json: Whether to print JSON.

    Returns:
        True if all responses are within their bounds.

    Raises:
        Failure: If no operator commanded a level.
    """
    response = measure_response(recording)
    if response is None:
        raise Failure(
            f"{recording.folder}: no operator commanded a level of its hierarchy;"
            " see 'rack command' and [[command]]",
            2,
        )
    folder.mkdir(parents=True, exist_ok=True)
    document = response.to_document()
    write_json(folder / "response.json", document)
    files = f"{folder}/response.json"
    if can_draw():
        files += "".join(f", {path.name}" for path in plot_response(response, folder))
    else:
        files += f"; {NO_PICTURES}"
    if as_json:
        print_json(document)
    else:
        print_blocks((*response.format_blocks(), "", files))
    return response.is_within_bounds


def plot_response(response: OperatorResponse, folder: Path) -> list[Path]:
    """Write a histogram per level with its bounds to response.png and response.svg.

    Returns:
        Paths of the pictures.
    """
    measured = {command.level for command in response.measured_commands}
    levels = [level for level in response.paths if level in measured]
    paths = list_picture_paths(folder / "response")
    with open_figure(paths, 8.0, 0.8 + 1.7 * len(levels)) as figure:
        axes = figure.subplots(len(levels), 1, squeeze=False)
        for axis, level in zip(axes[:, 0], levels, strict=True):
            _plot_level(axis, response, level)
        time = "simulated time" if response.lockstep else "the wall clock"
        axes[-1, 0].set_xlabel(
            f"from giving a command to the torque that rests on it, ms of {time}"
        )
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside upper center", ncols=2, frameon=False, fontsize="small"
        )
    return paths


def _plot_level(axis: Axes, response: OperatorResponse, level: str) -> None:
    """Draw the histogram of a level's responses, with its bounds."""
    from matplotlib.ticker import MaxNLocator

    path = response.paths[level]
    tick_ms = response.tick_ms
    own = [command for command in response.measured_commands if command.level == level]
    wait = path.delay + path.reads[0].every - 1
    lines = (
        (wait + path.sum_eq_3_3, SUM, "-.", "longest wait to be read + sum, eq. 3.3"),
        (path.longest, GRID, "--", "longest on the grid"),
        (wait + path.bound_eq_3_2, BOUND, "-", "longest wait to be read + bound, eq. 3.2"),
    )
    values = [(c.ticks or 0) * tick_ms if c.wall_ms is None else c.wall_ms for c in own]
    end_ms = max(lines[2][0] * tick_ms, *values)
    axis.hist(values, HISTOGRAM_BARS, range=(0.0, end_ms), color=MEASURED, label="measured")
    for at, colour, style, label in lines:
        axis.axvline(at * tick_ms, color=colour, linestyle=style, label=label)
    axis.set_xlim(0.0, 1.04 * end_ms)
    axis.set_ylabel("commands")
    axis.yaxis.set_major_locator(MaxNLocator(integer=True))
    axis.set_title(f"{' > '.join(path.levels)}: {len(own)} commands", fontsize="small", loc="left")
    axis.spines[["top", "right"]].set_visible(False)
