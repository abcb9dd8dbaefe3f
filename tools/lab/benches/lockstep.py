"""How fast racks run in lockstep: next to the same levels in one process without a rack, and to
another checkout.

The limit is honest only if it is the same work: once, its last messages and their numbers are
compared with those of a recorded run. It counts processor time, which nothing else on the machine
prolongs.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from rack.boards import OneProcess
from rack.boards.config import RackConfig, load
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.console.tables import table
from rack.tools.lab.benches.apart import apart
from rack.tools.lab.benches.checkout import RackCommand, rack_commands
from rack.tools.lab.benches.harness import BenchResult, Comparison, Sample, interleaved, shown
from rack.tools.recording.recording import Recording

RACKS: Mapping[str, float | None] = {"nasrem": None, "k1607": None, "fig4": 10.0}
"""The racks, and the simulated seconds of a run; None: until the task ends."""
BARE = "no rack"
EXPECTED_S = 10.0
"""About how long a run takes."""
BOUND_S = 600.0


@dataclass(frozen=True)
class BareRun:
    """A finished run of levels alone. `processor_s` is the time of its ticks.

    `last` is the newest message of each mailbox that was visible before the end, `serials` its
    number; without one, a mailbox is left out.
    """

    ticks: int
    processor_s: float
    serials: Mapping[str, int]
    last: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class LockstepSpeeds(BenchResult):
    """The time that a simulated second takes, by rack and contestant; `speeds` are simulated
    seconds a second, of the median."""

    comparison: Comparison
    speeds: Mapping[tuple[str, str], float]

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        speeds = [
            {"rack": rack, "who": who, "value": value} for (rack, who), value in self.speeds.items()
        ]
        return {**self.comparison.document(), "simulated_seconds_a_second": speeds}

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield both tables for people, fitted to `width`."""
        who = list(dict.fromkeys(who for _, who in self.speeds))
        racks = dict.fromkeys(rack for rack, _ in self.speeds)
        rows = [[rack, *(shown(self.speeds[rack, one]) for one in who)] for rack in racks]
        yield "Simulated seconds a second in lockstep"
        yield from table(["rack", *who], rows, width)
        yield ""
        yield from self.comparison.lines(width)

    def plot(self, folder: Path) -> list[Path]:
        """Write lockstep.png and lockstep.svg into `folder`; return their paths."""
        return self.comparison.plot(folder)


def measure(
    against: Path | None, racks: Mapping[str, float | None], rounds: int, progress: Progress
) -> LockstepSpeeds:
    """Run every rack, its levels without a rack, and another checkout's, by turns; times in ms a
    simulated second.

    Raises `Failure` if a run fails, or if the levels without a rack did other work.
    """
    commands = rack_commands(against)
    progress.total(EXPECTED_S * len(racks) * (1 + rounds * (1 + len(commands))))
    found: dict[tuple[str, str], list[float]] = {}
    for rack, seconds in racks.items():
        progress.begin(f"{rack}: recorded, and compared with its levels without a rack")
        with TemporaryDirectory() as folder:
            ticks = _check(rack, seconds, Path(folder) / "run")
        progress.end(EXPECTED_S, "equal")
        runs = {(rack, each.name): partial(_run, each, rack, seconds) for each in commands}
        runs[rack, BARE] = partial(_run_bare, rack, ticks)
        found |= interleaved(runs, rounds, progress, EXPECTED_S)
    return speeds(found, [command.name for command in commands])


def speeds(found: Mapping[tuple[str, str], list[float]], names: list[str]) -> LockstepSpeeds:
    """Return the speeds from the times of runs, ms a simulated second; the last of two `names` is
    compared with."""
    samples: list[Sample] = []
    baselines: dict[str, str] = {}
    for rack in dict.fromkeys(rack for rack, _ in found):
        own = [Sample(rack, who, tuple(found[rack, who]), "ms") for who in (*names, BARE)]
        if len(names) > 1:
            samples += own[:-1]
            baselines[rack] = names[-1]
        samples += [replace(sample, case=_limit(rack)) for sample in own]
        baselines[_limit(rack)] = BARE
    title = "Time of a simulated second in lockstep"
    comparison = Comparison("lockstep", title, tuple(samples), baselines)
    a_second = {key: float(1e3 / np.median(times_ms)) for key, times_ms in found.items()}
    return LockstepSpeeds(comparison, a_second)


def _limit(rack: str) -> str:
    """Return the case in which a rack is compared with its levels alone."""
    return f"{rack} and its limit"


def _run(command: RackCommand, rack: str, seconds: float | None) -> float:
    tick_us = command.tick_us(rack, *_options(seconds), bound_s=BOUND_S)
    return _ms_a_second(rack, tick_us)


def _options(seconds: float | None) -> list[object]:
    until = [] if seconds is None else ["--seconds", seconds]
    return ["--set", f"name=bench-{os.getpid()}", *until]


def _run_bare(rack: str, ticks: int) -> float:
    return _ms_a_second(rack, _bare(rack, ticks).processor_s * 1e6 / ticks)


def _ms_a_second(rack: str, tick_us: float) -> float:
    return tick_us * 1e6 / load(rack).clock_ns


def _bare(rack: str, ticks: int) -> BareRun:
    return apart(run_bare, load(rack, ["clock.mode=lockstep"]), ticks)


def run_bare(config: RackConfig, ticks: int) -> BareRun:
    """Run a rack's levels in this process for so many ticks."""
    with OneProcess(config) as rack:
        start_ns = time.process_time_ns()
        rack.run_ticks(ticks)
        processor_s = (time.process_time_ns() - start_ns) * 1e-9
        last = {name: rack.newest(name).record[()].copy() for name in rack.serials}
        return BareRun(ticks, processor_s, rack.serials, last)


def _check(rack: str, seconds: float | None, folder: Path) -> int:
    """Record a rack in lockstep and compare it with its levels alone; return the ticks that it ran
    for."""
    words = ("run", rack, "--lockstep", *_options(seconds), "--out", folder)
    rack_commands(None)[0].run(*words, bound_s=BOUND_S)
    recording = Recording(folder)
    ticks = int(recording.ended["outcome"]["ticks"])
    differing = list(differences(recording, _bare(rack, ticks)))
    if differing:
        raise Failure(
            f"{rack}: its levels without a rack did other work, first seen in {differing[0]}"
        )
    return ticks


def differences(recording: Recording, bare: BareRun) -> Iterator[str]:
    """Yield every mailbox, or field of a message, in which a recorded run and its levels alone
    differ.

    The message of each mailbox is the newest that was visible before the end. A later one need not
    be recorded.
    """
    for name in sorted({*recording.mailboxes, *bare.serials}):
        seen = np.flatnonzero(recording.signal(name, "visible_at") < bare.ticks)
        serial = recording.signal(name, "serial")[seen[-1]] if len(seen) else None
        if serial != bare.serials.get(name):
            yield f"the number of messages in {name}"
        elif serial is not None:
            last = bare.last[name]
            for field in sorted(recording.fields(name) & set(last.dtype.names or ())):
                if not np.array_equal(
                    _plain(recording.signal(name, field)[seen[-1]]), _plain(last[field])
                ):
                    yield f"{name}, field {field}"


def _plain(value: Any) -> Any:
    """Return a value of a message; text as the recorder stores it."""
    return value.decode("ascii", "replace") if isinstance(value, bytes) else value
