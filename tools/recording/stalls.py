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
from rack.boards.timing.trace_times import STAMPS, Occupation, is_missed, skipped
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
    meanwhile.
    """

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
    while it rose.
    """

    lost: int
    during_steal: int
    absences: list[Absence]
    quota: Quota | None


def stalls_of(recording: Recording) -> tuple[Stalls, dict[int, Occupation]]:
    """Return what took the cycles of a run, and by core when it was away.

    While the clock's core is away without steal, the whole machine may be: that counts for every
    core.
    """
    clock = recording.rack_config.clock
    home = obtained_core(clock.core)
    cycles = _Cycles(recording)
    # In lockstep nothing is due at a time.
    is_shown = clock.mode == "realtime" and clock.priority > 0 and cycles.is_urgent.any()
    late_clock = cycles.late_clock(recording.events if is_shown else [])
    without_clock = Occupation(*late_clock)
    spans = np.array(recording.cores.stolen or (), np.int64).reshape(-1, 4)
    away = {}
    absences = []
    during_steal = 0
    for core in dict.fromkeys([home, *cycles.core.tolist()]):
        here = cycles.core == core
        is_home = core == home
        stolen = Occupation(*spans[spans[:, 2] == core, :2].T)
        since, until = late_clock if is_home else cycles.unstamped(here, is_shown)
        # Without the clock no task is released: the other cores need not have been away.
        known = stolen if is_home else Occupation.union([stolen, without_clock])
        is_away = until - since > cycles.grid_ns // LATE_PART
        is_away &= known.within(since, until) == 0
        unstolen = Occupation(since[is_away], until[is_away])
        if len(lasted := unstolen.ends - unstolen.starts):
            lost = cycles.lost_during(unstolen, here | is_home)
            absences.append(Absence(core, len(lasted), int(lasted.max()) / 1e6, lost))
        during_steal += cycles.lost_during(stolen, here)
        away[core] = Occupation.union([stolen, unstolen, without_clock])
    levels_ns = {
        task.name: task.every * cycles.grid_ns
        for task in recording.layout.tasks
        if task.role == "executor"
    }
    quota = _quota(cycles.ends(), levels_ns)
    return Stalls(int(cycles.lost.sum()), during_steal, absences, quota), away


class _Cycles:
    """All cycles of a run, task by task.

    Attributes:
        rows: Trace records, shape (n,), as all that follow.
        core: Core of the task.
        is_urgent: Whether it has a real-time priority.
        due_ns: Release of the first cycle that was skipped before this one, or of this one.
        resumed_ns: Time at which what cost cycles was over.
        lost: Cycles that this one and those skipped before it cost.
        grid_ns: Time of a tick.
    """

    def __init__(self, recording: Recording) -> None:
        tasks = recording.layout.tasks
        traces = [recording.trace(task.name) for task in tasks]
        places = [(*recording.place(task), task.every) for task in tasks]
        self.rows = rows = np.concatenate(traces)
        self.core, priority, every = np.repeat(places, [len(trace) for trace in traces], axis=0).T
        self.is_urgent = priority > 0
        self.grid_ns = recording.rack_config.tick_ns
        self.due_ns = rows["release_ns"] - skipped(rows) * every * self.grid_ns
        # What cost releases was over as the next cycle began; what made a cycle late may have come
        # in its midst.
        self.resumed_ns = np.where(is_missed(rows), rows["end_ns"], rows["start_ns"])
        self.lost = skipped(rows) + is_missed(rows)

    def lost_during(self, occupied: Occupation, among: np.ndarray) -> int:
        """Return how many cycles were lost while a core was occupied, `among` some of them."""
        is_hit = occupied.within(self.due_ns, self.resumed_ns) > 0
        return int(self.lost[among & is_hit].sum())

    def ends(self) -> np.ndarray:
        """Return when the spans ended in which cycles of executors were lost."""
        # A plan may be due for longer than a stall lasts.
        counted = (self.lost > 0) & (self.rows["flags"] & Flag.PLANNED == 0)
        return Occupation(self.due_ns[counted], self.resumed_ns[counted]).ends

    def late_clock(self, events: list[Document]) -> tuple[np.ndarray, np.ndarray]:
        """Return since when the clock's board was away, due at a grid point, and until when."""
        late = [
            (e["since"], e["value"])
            for e in events
            if e.get("code") == "clock_late" and e["board"] == CLOCK
        ]
        since, late_ns = np.array(late, np.int64).reshape(-1, 2).T
        # All releases are on the clock's grid.
        begun_ns = (self.rows["release_ns"] - self.rows["tick"] * self.grid_ns).max(initial=0)
        due_ns = begun_ns + since * self.grid_ns
        return due_ns, due_ns + late_ns

    def unstamped(self, here: np.ndarray, is_shown: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return since when each cycle of a core was due and no task left a stamp there, until it
        started.
        """
        rows = self.rows[here]
        starts = rows["start_ns"]
        due_ns = np.where(is_shown & self.is_urgent, self.due_ns, self.rows["start_ns"])[here]
        stamps = np.sort(np.concatenate([rows[name] for name in STAMPS]))
        # Before its first stamp a core is not judged: place -1 is the last stamp of the run.
        return np.maximum(due_ns, stamps[np.searchsorted(stamps, starts) - 1]), starts


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
