"""What took the cores of a rack in real time: the hypervisor by the kernel's count, or without one,
or a host's quota.

A host that takes a core away need not count that as steal. It then shows where the rack was due and
left no stamp: the clock's board, which preempts all else on its core, woke late (its own
`CLOCK_LATE`); or a task was due on another core and no task left a stamp there. Both must have a
real-time priority: without one they wait for any program. Alternative considered: a trace of the
clock. It shows no more, and needs a ring of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.clock.driver import LATE_PART
from rack.backplane.trace import Flag
from rack.boards.config.layout import obtained_core
from rack.levels.timing.trace_times import STAMPS, Occupation, is_missed, skipped
from rack.tools.console.answer import Document
from rack.tools.recording.recording import Recording

QUOTA_NS = 100_000_000
"""Period of quotas: the default of Linux (cpu.max), and so of libvirt, Docker and Kubernetes."""
LEAST_STALLS = 5
CLUSTERED = 0.75
WINDOW = 0.02
"""So many stalls, of which this part ends within one window, a part of the period, are no chance.

With phases that have nothing to do with the period, four of five end within 2 % of it once in 6,300
runs; more stalls make that rarer still. Three quarters, since a level that is late by itself ends
at few phases: at two, if its cycle is half the period.
"""


@dataclass(frozen=True)
class Absence:
    """A core that was away without steal: how often, the longest time, and the cycles lost
    meanwhile."""

    core: int
    times: int
    longest_ms: float
    lost: int


@dataclass(frozen=True)
class Quota:
    """Stalls that end at one phase of `QUOTA_NS`: `together` of `stalls`.

    They also end at one phase of the cycles of `levels`, multiples of that, which may then be the
    cause.
    """

    together: int
    stalls: int
    levels: list[str]


@dataclass(frozen=True)
class Stalls:
    """What took the cycles of a run: `lost` counts all, late or skipped, `during_steal` those due
    while it rose."""

    lost: int
    during_steal: int
    absences: list[Absence]
    quota: Quota | None


def stalls_of(recording: Recording) -> tuple[Stalls, dict[int, Occupation]]:
    """Return what took the cycles of a run, and by core when it was away.

    While the clock's core is away without steal, the whole machine may be: that counts for every
    core.
    """
    config = recording.rack_config
    tasks = recording.layout.tasks
    grid_ns = config.tick_ns
    home = obtained_core(config.clock.core)
    traces = [recording.trace(task.name) for task in tasks]
    rows = np.concatenate(traces)
    places = [(*recording.place(task), task.every) for task in tasks]
    on, priority, every = np.repeat(places, [len(trace) for trace in traces], axis=0).T
    # Releases skipped before a cycle were due before it.
    due = rows["release_ns"] - skipped(rows) * every * grid_ns
    # In lockstep nothing is due at a time.
    is_shown = config.clock.mode == "realtime" and config.clock.priority > 0 and priority.any()
    clock = _late_clock(recording.events if is_shown else [], rows, grid_ns)
    without_clock = Occupation(*clock)
    urgent = np.where(is_shown & (priority > 0), due, rows["start_ns"])
    # What cost releases was over as the next cycle began; what made a cycle late may have come in
    # its midst.
    resumed = np.where(is_missed(rows), rows["end_ns"], rows["start_ns"])
    lost = skipped(rows) + is_missed(rows)
    spans = np.array(recording.cores.stolen or (), np.int64).reshape(-1, 4)
    away = {}
    absences = []
    during_steal = 0

    def lost_during(occupied: Occupation, among: np.ndarray) -> int:
        return int(lost[among & (occupied.within(due, resumed) > 0)].sum())

    for core in dict.fromkeys([home, *on.tolist()]):
        here = on == core
        is_home = core == home
        stolen = Occupation(*spans[spans[:, 2] == core, :2].T)
        since, until = clock if is_home else _unstamped(rows[here], urgent[here])
        # Without the clock no task is released: the other cores need not have been away.
        known = stolen if is_home else Occupation.union([stolen, without_clock])
        is_away = (until - since > grid_ns // LATE_PART) & (known.within(since, until) == 0)
        unstolen = Occupation(since[is_away], until[is_away])
        if len(lasted := unstolen.ends - unstolen.starts):
            cycles = lost_during(unstolen, here | is_home)
            absences.append(Absence(core, len(lasted), int(lasted.max()) / 1e6, cycles))
        during_steal += lost_during(stolen, here)
        away[core] = Occupation.union([stolen, unstolen, without_clock])
    # A plan may be due for longer than a stall lasts.
    counted = (lost > 0) & (rows["flags"] & Flag.PLANNED == 0)
    cycles_ns = {task.name: task.every * grid_ns for task in tasks if task.role == "executor"}
    quota = _quota(Occupation(due[counted], resumed[counted]).ends, cycles_ns)
    return Stalls(int(lost.sum()), during_steal, absences, quota), away


def _late_clock(
    events: list[Document], rows: np.ndarray, grid_ns: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return since when the clock's board was away, due at a grid point, and until when; `rows` are
    on its grid."""
    late = [
        (e["since"], e["value"])
        for e in events
        if e.get("code") == "clock_late" and e["board"] == CLOCK
    ]
    since, late_ns = np.array(late, np.int64).reshape(-1, 2).T
    due = (rows["release_ns"] - rows["tick"] * grid_ns).max(initial=0) + since * grid_ns
    return due, due + late_ns


def _unstamped(rows: np.ndarray, due: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return since when each cycle of a core, all its `rows`, was due and no task left a stamp,
    until it started."""
    stamps = np.sort(np.concatenate([rows[name] for name in STAMPS]))
    # Before its first stamp a core is not judged: place -1 is the last stamp of the run.
    return np.maximum(due, stamps[np.searchsorted(stamps, rows["start_ns"]) - 1]), rows["start_ns"]


def _quota(ends: np.ndarray, cycles_ns: dict[str, int]) -> Quota | None:
    """Return at how many of the `ends` of stalls a quota ended, if that is no chance; `cycles_ns`
    are by level.

    Lost cycles that overlap, on any core, are one stall; it ends as the last of them runs again.
    """
    if len(ends) < LEAST_STALLS or (together := _at_one_phase(ends, QUOTA_NS)) < CLUSTERED * len(
        ends
    ):
        return None
    levels = [
        name
        for name, ns in cycles_ns.items()
        if not ns % QUOTA_NS and _at_one_phase(ends, ns) >= together
    ]
    return Quota(together, len(ends), levels)


def _at_one_phase(ends: np.ndarray, period_ns: int) -> int:
    """Return the largest number of times within one window of a period."""
    phases = np.sort(ends % period_ns)
    around = np.append(phases, phases + period_ns)
    following = np.searchsorted(around, phases + WINDOW * QUOTA_NS, side="right")
    return int((following - np.arange(len(phases))).max())
