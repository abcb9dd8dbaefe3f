"""Finds the times at which cores were unavailable to a rack in real time, and the causes.

A core is unavailable, or absent, while the hypervisor or a CPU quota of the host withholds it. The
kernel may or may not count that time as steal. Without steal, an absence is inferred from missing
time stamps. On the clock's core, the clock, which preempts everything else, woke late (event
`CLOCK_LATE`). On any other core, a task was due but no task recorded a time stamp. Both are
considered only for real-time priorities, because a task without one may wait for other programs.
Alternative considered: a trace of the clock board, which would show nothing more but need another
ring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.clock.driver import LATE_DIVISOR
from rack.boards.config.layout import find_core
from rack.boards.timing.trace_times import (
    STAMPS,
    Occupation,
    count_skipped_releases,
    find_missed_cycles,
)
from rack.tools.console.answer import Document
from rack.tools.recording.recording import Recording


@dataclass(frozen=True)
class Absence:
    """Summary of the times at which a core was unavailable although no steal was counted.

    Attributes:
        core: Number of the core.
        times: Number of absences.
        longest_ms: Duration of the longest absence.
        lost: Number of cycles that were late or skipped because of the absences.
    """

    core: int
    times: int
    longest_ms: float
    lost: int


@dataclass(frozen=True)
class Stalls:
    """Lost cycles of a run, which were late or skipped, and the absences of cores.

    Attributes:
        lost: Number of all lost cycles.
        during_steal: Number of lost cycles that were due while the steal of their core increased.
        absences: One summary for each core that was absent without steal.
    """

    lost: int
    during_steal: int
    absences: list[Absence]


def analyze_stalls(recording: Recording) -> tuple[Stalls, dict[int, Occupation]]:
    """Find the absences of cores in a run, and the late or skipped cycles that they caused.

    If the clock's core is absent without steal, the whole machine may be stopped. Such a time
    therefore counts as an absence of every core.

    Returns:
        The summary, and a dictionary from core to the times at which it was absent.
    """
    clock = recording.rack_config.clock
    clock_core = find_core(clock.core)
    cycles = _CycleTable(recording)
    # In lockstep no cycle has a due time.
    is_shown = clock.mode == "realtime" and clock.priority > 0 and cycles.is_urgent.any()
    late_clock = cycles.find_clock_absences(recording.events if is_shown else [])
    without_clock = Occupation(*late_clock)
    spans = np.array(recording.cores.stolen or (), np.int64).reshape(-1, 4)
    absent_spans = {}
    absences = []
    during_steal = 0
    for core in dict.fromkeys([clock_core, *cycles.core.tolist()]):
        on_core = cycles.core == core
        is_home = core == clock_core
        stolen = Occupation(*spans[spans[:, 2] == core, :2].T)
        since, until = late_clock if is_home else cycles.find_idle_spans(on_core, is_shown)
        # While the clock's core is absent, no task is released, so other cores are idle as well.
        explained = stolen if is_home else Occupation.merge([stolen, without_clock])
        is_away = until - since > cycles.grid_ns // LATE_DIVISOR
        is_away &= explained.compute_overlap(since, until) == 0
        unstolen = Occupation(since[is_away], until[is_away])
        if len(durations_ns := unstolen.ends - unstolen.starts):
            lost = cycles.count_lost_during(unstolen, on_core | is_home)
            absences.append(Absence(core, len(durations_ns), int(durations_ns.max()) / 1e6, lost))
        during_steal += cycles.count_lost_during(stolen, on_core)
        absent_spans[core] = Occupation.merge([stolen, unstolen, without_clock])
    return Stalls(int(cycles.lost.sum()), during_steal, absences), absent_spans


class _CycleTable:
    """The cycles of all tasks of a run, with the data to find the cause of lost cycles.

    A cycle is lost if it was late or skipped. All arrays have shape (n,).

    Attributes:
        rows: Trace records.
        core: Core of the task.
        is_urgent: True if the task has a real-time priority.
        due_ns: Release of this cycle, or of the first cycle skipped before it.
        ready_ns: Release from which the task waited for its core: that of this cycle if the
            previous cycle ended after `due_ns`.
        resumed_ns: Time at which the cause of the lost cycles had ended: the end of a late cycle,
            or the start of a cycle after skipped ones.
        lost: Number of lost cycles: this one if late, and those skipped before it.
        grid_ns: Length of a tick in real time.
    """

    def __init__(self, recording: Recording) -> None:
        tasks = recording.layout.tasks
        traces = [recording.read_trace(task.name) for task in tasks]
        places = [(*recording.find_core_and_priority(task), task.every) for task in tasks]
        self.rows = rows = np.concatenate(traces)
        self.core, priority, every = np.repeat(places, [len(trace) for trace in traces], axis=0).T
        self.is_urgent = priority > 0
        self.grid_ns = recording.rack_config.tick_ns
        self.due_ns = rows["release_ns"] - count_skipped_releases(rows) * every * self.grid_ns
        ended_ns = np.concatenate(
            [np.append(0, trace["end_ns"][:-1])[: len(trace)] for trace in traces]
        )
        self.ready_ns = np.where(ended_ns > self.due_ns, rows["release_ns"], self.due_ns)
        # The cause of skipped releases had ended when the next cycle began. The cause of a late
        # cycle may have occurred during that cycle.
        self.resumed_ns = np.where(find_missed_cycles(rows), rows["end_ns"], rows["start_ns"])
        self.lost = count_skipped_releases(rows) + find_missed_cycles(rows)

    def count_lost_during(self, occupied: Occupation, among: np.ndarray) -> int:
        """Count the lost cycles whose delay overlaps a time at which their core was unavailable.

        Args:
            occupied: Times at which the core was unavailable.
            among: Mask of the cycles to consider.
        """
        is_hit = occupied.compute_overlap(self.due_ns, self.resumed_ns) > 0
        return int(self.lost[among & is_hit].sum())

    def find_clock_absences(self, events: list[Document]) -> tuple[np.ndarray, np.ndarray]:
        """Find the due and the actual time of each late wake-up of the clock board.

        Args:
            events: Events of the run. Only events with code "clock_late" are used.

        Returns:
            Due and actual times, in ns of CLOCK_MONOTONIC.
        """
        late = [
            (e["since"], e["value"])
            for e in events
            if e.get("code") == "clock_late" and e["board"] == CLOCK
        ]
        since, late_ns = np.array(late, np.int64).reshape(-1, 2).T
        # All releases lie on the clock's grid, so the time of tick 0 follows from any row.
        start_ns = (self.rows["release_ns"] - self.rows["tick"] * self.grid_ns).max(initial=0)
        due_ns = start_ns + since * self.grid_ns
        return due_ns, due_ns + late_ns

    def find_idle_spans(self, on_core: np.ndarray, is_shown: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return, for each cycle on a core, the span in which it was due but no task ran.

        Args:
            on_core: Mask of the cycles on that core.
            is_shown: Whether due times show absences. If not, as in lockstep, all spans are empty.

        Returns:
            Start and end time of each span, in ns of CLOCK_MONOTONIC.
        """
        rows = self.rows[on_core]
        starts = rows["start_ns"]
        due_ns = np.where(is_shown & self.is_urgent, self.ready_ns, self.rows["start_ns"])[on_core]
        stamps = np.sort(np.concatenate([rows[name] for name in STAMPS]))
        # A span begins no earlier than the last stamp on the core before the cycle. For the
        # first cycle, index -1 selects the last stamp of the run, so its span is empty.
        return np.maximum(due_ns, stamps[np.searchsorted(stamps, starts) - 1]), starts
