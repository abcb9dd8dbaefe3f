"""Table-driven buffers next to interrupt-driven messages: the racks hic and condor, with the same
hand and task."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp

import numpy as np

from rack.boards.config import load
from rack.levels.systems.hand.messages import GraspKind
from rack.levels.timing.chains import spanned
from rack.levels.timing.trace_times import counts
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.exchange_times import ExchangeTimes, exchange_times
from rack.tools.lab.benches.hand_figures import HandBench, HandFigures, LinkFigures
from rack.tools.lab.benches.harness import interleaved
from rack.tools.lab.benches.observed import Recorded, record
from rack.tools.live.interrupts import interrupts
from rack.tools.recording.cycles import cycles_of
from rack.tools.recording.recording import Recording

RACKS = ("hic", "condor")
MODES = ("realtime", "lockstep")
LAUNCH_S = 5.0
"""About how long launching and recording a run take in addition to its time."""
ABOUT_S = 13.0
"""About how long a run takes in simulated time."""
SETTLED_S = 0.3
"""Simulated time after the end of a pull in which the object comes back."""


def measure(
    rounds: int, share: bool, progress: Progress, racks: Sequence[str] = RACKS
) -> HandBench:
    """Run both racks in both modes by turns; return their figures."""
    each_s = ABOUT_S + LAUNCH_S
    progress.total(2 * len(racks) * rounds * each_s)
    with TemporaryDirectory(prefix="rack-bench-") as scratch:
        runs = {
            (rack, mode): partial(_run, rack, mode, scratch, share)
            for mode in MODES
            for rack in racks
        }
        found = interleaved(runs, rounds, progress, each_s)
        return HandBench(tuple(_figures(*name, ran) for name, ran in found.items()))


def _run(rack: str, mode: str, scratch: str, share: bool) -> Recorded:
    config = load(rack, [f"name=hand-{os.getpid()}", f"clock.mode={mode}", "clock.speed=1.0"])
    return record(config, None, Path(mkdtemp(dir=scratch)), share)


def _figures(rack: str, mode: str, runs: Sequence[Recorded]) -> HandFigures:
    shifts = [shift for ran in runs if (shift := shift_mm(ran.recording)) is not None]
    misses = [counts(rows) for ran in runs for rows in ran.recording.cycles.values()]
    costs_ms = np.array([_costs_ms(ran.recording) for ran in runs]).max(axis=0).tolist()
    exchange_ms, process_ms, handler_ms = costs_ms
    return HandFigures(
        rack=rack,
        mode=mode,
        rounds=len(runs),
        links=tuple(_links([ran.recording for ran in runs])),
        shift_mm=max((most for most, _ in shifts), default=None),
        left_mm=max((left for _, left in shifts), default=None),
        exchange_ms=exchange_ms,
        process_ms=process_ms,
        handler_ms=handler_ms,
        missed=sum(map(sum, misses)),
        cycles=sum(len(rows) for ran in runs for rows in ran.recording.cycles.values()),
        digests=tuple(ran.result.outcome.digest for ran in runs),
        failure="; ".join(ran.result.failure() for ran in runs if not ran.result.worked),
    )


def shift_mm(recording: Recording) -> tuple[float, float] | None:
    """Return how far the pulls move the object, and how far it is from its place after the last
    one, mm.

    None if it is not held in all that time, or not seen before and during the pulls.
    """
    config = recording.rack_config
    clock_s = recording.layout.clock_ns * 1e-9
    pulls = config.scene.push
    ending = next(name for name, board in config.board.items() if board.ends_run)
    begin = min(pull.at for pull in pulls)
    end = max(pull.at + pull.seconds for pull in pulls) + SETTLED_S
    held = recording.signal(f"{ending}.status", "kind") == GraspKind.HOLD
    times = recording.signal(f"{ending}.status", "tick") * clock_s
    if not held[(times >= begin) & (times <= end)].all() or times[-1] < end:
        return None
    scene = next(box.name for box in recording.layout.mailboxes if box.message == "scene")
    times = recording.signal(scene, "tick") * clock_s
    row = config.scene.objects.index(pulls[0].body)
    place = recording.signal(scene, "position")[:, row]
    before = place[times < begin]
    pulled = place[(times >= begin) & (times <= end)]
    if not len(before) or not len(pulled):
        return None
    away = 1e3 * np.sqrt(((pulled - before[-1]) ** 2).sum(axis=1))
    return float(away.max()), float(away[-1])


def _costs_ms(recording: Recording) -> tuple[float, float, float]:
    """Return the processor times of all boards for messages, for the rest, and of interrupts by
    their cost model.

    They are ms in a second of simulated time.
    """
    found = cycles_of(recording)
    layout = recording.layout
    exchanged = sum(float(cycles.communication_ns.sum()) for cycles in found.values())
    processed = sum(float(cycles.process_ns.sum()) for cycles in found.values())
    service_ns = {
        box.name: box.interrupt.service_ns for box in layout.mailboxes if box.interrupt is not None
    }
    served = (one for board in interrupts(recording) for one in board["mailboxes"])
    handled = sum(one["served"] * service_ns[one["mailbox"]] for one in served)
    ticks = max(int(cycles.rows["tick"][-1]) for cycles in found.values())
    per_s = 1e-6 / (ticks * layout.clock_ns * 1e-9)
    return exchanged * per_s, processed * per_s, handled * per_s


def _links(runs: Sequence[Recording]) -> Iterator[LinkFigures]:
    """Yield the links of a rack; mailboxes of one message type from or to several boards that do
    the same are one."""
    groups: dict[tuple[str, str, str], list[ExchangeTimes]] = {}
    # All runs are of one rack.
    layout = runs[0].layout
    tick_ms = layout.clock_ns * 1e-6
    doing = {name: board.executor for name, board in runs[0].rack_config.board.items()}
    for run in runs:
        for times in exchange_times(run):
            if times.writer in doing and times.reader in doing and times.writer != times.reader:
                message = layout.mailbox(times.mailbox).message
                key = message, doing[times.writer], doing[times.reader]
                groups.setdefault(key, []).append(times)
    for (message, _, _), alike in groups.items():
        yield LinkFigures(
            message=message,
            writers=spanned(list(dict.fromkeys(times.writer for times in alike))),
            readers=spanned(list(dict.fromkeys(times.reader for times in alike))),
            protocol=alike[0].protocol,
            period_ms=layout.mailbox(alike[0].mailbox).every * tick_ms,
            jitter_p50_ms=_most(alike, "jitter_ms", "p50"),
            jitter_max_ms=_most(alike, "jitter_ms", "max"),
            age_p50_ms=_most(alike, "age_ms", "p50"),
            age_max_ms=_most(alike, "age_ms", "max"),
            sent=sum(times.sent for times in alike),
            lost=sum(times.lost for times in alike),
            overtaken=sum(times.overtaken for times in alike),
        )


def _most(alike: Sequence[ExchangeTimes], what: str, key: str) -> float | None:
    found = [getattr(times, what) for times in alike]
    return max((one[key] for one in found if one is not None), default=None)
