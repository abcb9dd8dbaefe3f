"""Speed of racks in lockstep, compared with their levels in one process and another checkout.

The levels alone do the same work and write the same messages, which a test checks. Their processor
time is measured, because it does not include interruptions by other programs.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from rack.boards import OneProcess
from rack.boards.config import RackConfig, load
from rack.tools.console.answer import Document
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.apart import run_in_board_environment
from rack.tools.lab.benches.checkout import RackCommand, build_rack_commands
from rack.tools.lab.benches.harness import Comparison, Sample, call_interleaved, format_value

RACKS: Mapping[str, float | None] = {"nasrem": None, "k1607": None, "fig4": 10.0}
"""Simulated time of a run of each rack, s. None to run until its task ends."""
WITHOUT_RACK = "no rack"
EXPECTED_S = 10.0
"""Approximate time of a run, s."""
RUN_TIMEOUT_S = 600.0


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
        Failure: If a run fails.
    """
    commands = build_rack_commands(against)
    progress.set_total(EXPECTED_S * len(racks) * (1 + rounds * (1 + len(commands))))
    samples = []
    for rack, seconds in racks.items():
        progress.begin_run(f"{rack}: the length of its run")
        options = ["--set", f"name=bench-{os.getpid()}"]
        options += [] if seconds is None else ["--seconds", f"{seconds}"]
        ticks = _run_rack(commands[0], rack, options)["outcome"]["ticks"]
        progress.end_run(EXPECTED_S, f"{ticks} ticks")
        runs = {each.name: partial(_measure_rack_ms, each, rack, options) for each in commands}
        runs[WITHOUT_RACK] = partial(_measure_bare_ms, rack, ticks)
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


def _run_rack(command: RackCommand, rack: str, options: Sequence[object]) -> Document:
    """Run a rack with a command, and return its result."""
    arguments = ("run", rack, "--lockstep", "--no-record", "--json", *options)
    return dict(json.loads(command.run(*arguments, bound_s=RUN_TIMEOUT_S)))


def _measure_rack_ms(command: RackCommand, rack: str, options: Sequence[object]) -> float:
    """Run a rack with a command, and return the time per simulated second in ms."""
    result = _run_rack(command, rack, options)
    return _compute_ms_per_second(rack, result["wall_s"], result["outcome"]["ticks"])


def _measure_bare_ms(rack: str, ticks: int) -> float:
    """Run the levels without a rack, and return the time per simulated second in ms."""
    config = load(rack, ["clock.mode=lockstep"])
    return _compute_ms_per_second(rack, run_in_board_environment(run_bare, config, ticks), ticks)


def _compute_ms_per_second(rack: str, run_s: float, ticks: int) -> float:
    """Convert the time of a run, in s, to the time per simulated second, in ms."""
    return run_s / ticks * 1e12 / load(rack).clock_ns


def run_bare(config: RackConfig, ticks: int) -> float:
    """Run the levels of a rack in this process, and return the processor time of all ticks, s."""
    with OneProcess(config) as rack:
        start_ns = time.process_time_ns()
        rack.run_ticks(ticks)
        return (time.process_time_ns() - start_ns) * 1e-9
