"""How fast racks run in lockstep: next to the same levels in one process without a rack, and to
another checkout.

The limit is honest only if it is the same work: once, its last messages and their numbers are
compared with those of a recorded run. It counts processor time, which nothing else on the machine
prolongs.
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
from rack.tools.lab.benches.apart import apart
from rack.tools.lab.benches.checkout import RackCommand, rack_commands
from rack.tools.lab.benches.harness import Comparison, Sample, interleaved, shown
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


def measure(
    against: Path | None, racks: Mapping[str, float | None], rounds: int, progress: Progress
) -> Comparison:
    """Run every rack, its levels without a rack, and another checkout's, by turns; times in ms a
    simulated second.

    Raises:
        Failure: If a run fails, or if the levels without a rack did other work.
    """
    commands = rack_commands(against)
    progress.total(EXPECTED_S * len(racks) * (1 + rounds * (1 + len(commands))))
    samples = []
    for rack, seconds in racks.items():
        progress.begin(f"{rack}: recorded, and compared with its levels without a rack")
        options = ["--set", f"name=bench-{os.getpid()}"]
        options += [] if seconds is None else ["--seconds", f"{seconds}"]
        with TemporaryDirectory() as folder:
            ticks = _check(rack, options, Path(folder) / "run")
        progress.end(EXPECTED_S, "equal")
        runs = {each.name: partial(_run, each, rack, options) for each in commands}
        runs[BARE] = partial(_run_bare, rack, ticks)
        found = interleaved(runs, rounds, progress, EXPECTED_S)
        samples += [Sample(rack, who, tuple(times_ms), "ms") for who, times_ms in found.items()]
    return compare(samples, commands[-1].name if against else BARE)


def compare(samples: Sequence[Sample], baseline: str) -> Comparison:
    """Return the comparison of these samples with one contestant, and how many simulated seconds a
    second they are.
    """
    speeds = [f"{one.case} {shown(1e3 / one.median)} ({one.who})" for one in samples]
    return Comparison(
        name="lockstep",
        title="Time of a simulated second in lockstep",
        samples=tuple(samples),
        baselines=dict.fromkeys((sample.case for sample in samples), baseline),
        conclusion=f"simulated seconds a second: {', '.join(speeds)}",
    )


def _run(command: RackCommand, rack: str, options: Sequence[object]) -> float:
    """Return the time of a simulated second, ms."""
    words = ("run", rack, "--lockstep", "--no-record", "--json", *options)
    found = json.loads(command.run(*words, bound_s=BOUND_S))
    return _ms_a_second(rack, found["wall_s"], found["outcome"]["ticks"])


def _run_bare(rack: str, ticks: int) -> float:
    return _ms_a_second(rack, _bare(rack, ticks).processor_s, ticks)


def _ms_a_second(rack: str, lasted_s: float, ticks: int) -> float:
    return lasted_s / ticks * 1e12 / load(rack).clock_ns


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


def _check(rack: str, options: Sequence[object], folder: Path) -> int:
    """Record a rack in lockstep and compare it with its levels alone; return the ticks that it ran
    for.
    """
    words = ("run", rack, "--lockstep", *options, "--out", folder)
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
