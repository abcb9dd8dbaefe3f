"""Speed of racks in lockstep, compared with their levels in one process and another checkout.

The levels alone are a fair limit only if they do the same work. Their last messages and serials are
therefore compared once with a recorded run. Their processor time is measured, because it does not
include interruptions by other programs.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from rack.boards import OneProcess
from rack.boards.config import RackConfig, load
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.apart import run_in_board_environment
from rack.tools.lab.benches.checkout import RackCommand, build_rack_commands
from rack.tools.lab.benches.harness import Comparison, Sample, call_interleaved, format_value
from rack.tools.recording.recording import Recording

RACKS: Mapping[str, float | None] = {"nasrem": None, "k1607": None, "fig4": 10.0}
"""Simulated time of a run of each rack, s. None to run until its task ends."""
WITHOUT_RACK = "no rack"
EXPECTED_S = 10.0
"""Approximate time of a run, s."""
RUN_TIMEOUT_S = 600.0


@dataclass(frozen=True)
class BareRun:
    """A finished run of levels without a rack.

    Attributes:
        ticks: Length of the run.
        processor_s: Processor time of all ticks, s.
        serials: Serial of the newest message of each mailbox that was visible before the end.
            Mailboxes without a message are left out.
        last: Newest visible message of each of these mailboxes.
    """

    ticks: int
    processor_s: float
    serials: Mapping[str, int]
    last: Mapping[str, np.ndarray]


def measure_lockstep(
    against: Path | None, racks: Mapping[str, float | None], rounds: int, progress: Progress
) -> Comparison:
    """Measure the speed of each rack, of its levels alone, and of the rack in another checkout.

    The contestants run alternately.

    Args:
        against: The other checkout. None if there is none.
        racks: Simulated time of each rack, s. None to run until its task ends.
        rounds: Number of runs of each contestant.
        progress: Shows each run.

    Returns:
        Times per simulated second, ms.

    Raises:
        Failure: If a run fails, or if the messages of the levels alone differ from the rack's.
    """
    commands = build_rack_commands(against)
    progress.set_total(EXPECTED_S * len(racks) * (1 + rounds * (1 + len(commands))))
    samples = []
    for rack, seconds in racks.items():
        progress.begin_run(f"{rack}: recorded, and compared with its levels without a rack")
        options = ["--set", f"name=bench-{os.getpid()}"]
        options += [] if seconds is None else ["--seconds", f"{seconds}"]
        with TemporaryDirectory() as folder:
            ticks = _check_bare_run(rack, options, Path(folder) / "run")
        progress.end_run(EXPECTED_S, "equal")
        runs = {each.name: partial(_run_rack, each, rack, options) for each in commands}
        runs[WITHOUT_RACK] = partial(_run_bare, rack, ticks)
        times = call_interleaved(runs, rounds, progress, EXPECTED_S)
        samples += [Sample(rack, who, tuple(times_ms), "ms") for who, times_ms in times.items()]
    return build_comparison(samples, commands[-1].name if against else WITHOUT_RACK)


def build_comparison(samples: Sequence[Sample], baseline: str) -> Comparison:
    """Compare samples with those of `baseline`. The conclusion states the simulation speeds."""
    speeds = [f"{one.case} {format_value(1e3 / one.median)} ({one.who})" for one in samples]
    return Comparison(
        name="lockstep",
        title="Time of a simulated second in lockstep",
        samples=tuple(samples),
        baselines=dict.fromkeys((sample.case for sample in samples), baseline),
        conclusion=f"simulated seconds a second: {', '.join(speeds)}",
    )


def _run_rack(command: RackCommand, rack: str, options: Sequence[object]) -> float:
    """Run a rack with a command, and return the time per simulated second in ms."""
    result = json.loads(
        command.run(
            "run", rack, "--lockstep", "--no-record", "--json", *options, bound_s=RUN_TIMEOUT_S
        )
    )
    return _compute_ms_per_second(rack, result["wall_s"], result["outcome"]["ticks"])


def _run_bare(rack: str, ticks: int) -> float:
    """Run the levels without a rack, and return the time per simulated second in ms."""
    return _compute_ms_per_second(rack, _run_bare_apart(rack, ticks).processor_s, ticks)


def _compute_ms_per_second(rack: str, run_s: float, ticks: int) -> float:
    """Convert the time of a run, in s, to the time per simulated second, in ms."""
    return run_s / ticks * 1e12 / load(rack).clock_ns


def _run_bare_apart(rack: str, ticks: int) -> BareRun:
    """Run the levels without a rack in a new process with the environment of boards."""
    return run_in_board_environment(run_bare, load(rack, ["clock.mode=lockstep"]), ticks)


def run_bare(config: RackConfig, ticks: int) -> BareRun:
    """Run the levels of a rack in this process for a number of ticks."""
    with OneProcess(config) as rack:
        start_ns = time.process_time_ns()
        rack.run_ticks(ticks)
        processor_s = (time.process_time_ns() - start_ns) * 1e-9
        last = {name: rack.newest(name).record[()].copy() for name in rack.serials}
        return BareRun(ticks, processor_s, rack.serials, last)


def _check_bare_run(rack: str, options: Sequence[object], folder: Path) -> int:
    """Record a rack in lockstep and compare it with its levels alone.

    Args:
        rack: Config of the rack.
        options: Options of `rack run`.
        folder: Folder of the run.

    Returns:
        Length of the run, ticks.

    Raises:
        Failure: If the messages of the levels alone differ from those that were recorded.
    """
    this_tree = build_rack_commands(None)[0]
    this_tree.run("run", rack, "--lockstep", *options, "--out", folder, bound_s=RUN_TIMEOUT_S)
    recording = Recording(folder)
    ticks = int(recording.end_counts["outcome"]["ticks"])
    differing = list(find_differences(recording, _run_bare_apart(rack, ticks)))
    if differing:
        raise Failure(
            f"{rack}: its levels without a rack did different work, first in {differing[0]}"
        )
    return ticks


def find_differences(recording: Recording, bare: BareRun) -> Iterator[str]:
    """Yield every mailbox or message field in which a run of the levels alone differs.

    In each mailbox, only the newest message that was visible before the end is compared, because
    later messages may not be recorded.
    """
    for name in sorted({*recording.mailboxes, *bare.serials}):
        visible_rows = np.flatnonzero(recording.read_signal(name, "visible_at") < bare.ticks)
        serial = (
            recording.read_signal(name, "serial")[visible_rows[-1]] if len(visible_rows) else None
        )
        if serial != bare.serials.get(name):
            yield f"the number of messages in {name}"
        elif serial is not None:
            last = bare.last[name]
            for field in sorted(recording.list_fields(name) & set(last.dtype.names or ())):
                if not np.array_equal(
                    _to_plain_value(recording.read_signal(name, field)[visible_rows[-1]]),
                    _to_plain_value(last[field]),
                ):
                    yield f"{name}, field {field}"


def _to_plain_value(value: Any) -> Any:
    """Return a value of a message, with text converted as the recorder stores it."""
    return value.decode("ascii", "replace") if isinstance(value, bytes) else value
