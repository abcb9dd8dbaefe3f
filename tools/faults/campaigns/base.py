"""Faultless lockstep run, from whose snapshots trials continue.

Until its first fault, a trial equals this run bit for bit. The trial therefore continues from the
last snapshot before the fault and takes over the earlier events of this run. Its verdict is the
same as if it had begun at tick 0.
"""

from __future__ import annotations

import sys
from collections.abc import Set

from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.boards.errors import NO_SNAPSHOTS_PREFIX
from rack.boards.wiring import Continuation, SnapshotPolicy
from rack.tools.faults.campaigns.plan import NOMINAL, Plan
from rack.tools.faults.campaigns.trial import Start, Trial, run_trial

EVERY_S = 5.0
"""Simulated time between two snapshots. On average a trial repeats half of it."""


def count_base_ticks(config: RackConfig) -> int:
    """Return the number of ticks between two snapshots of the faultless rack."""
    return max(1, round(EVERY_S * 1e9 / config.clock_ns))


class BaseRack:
    """The faultless rack of one worker process.

    Its snapshots belong to the crate of the worker. Trials of the worker use the same rack name.
    Its boards run on any of `cores`, or on the cores of the config if there are none.
    """

    def __init__(self, config: RackConfig, name: str, cores: Set[int] = frozenset()) -> None:
        self.name = name
        self._cores = cores
        self._config = config
        self._every = count_base_ticks(config)
        self._crate: WarmCrate | None = None
        self._trial = Trial(NOMINAL)
        self._reached = 0
        self._why_none = config.outside_state

    def find_start(self, plan: Plan, crate: WarmCrate | None) -> Start:
        """Return the starting point of a trial. Run the faultless rack up to there if necessary.

        Args:
            plan: Plan of the trial.
            crate: Crate of the worker. None if it has none.
        """
        if not (plan.faults or plan.kills):
            return Start()
        if not plan.lockstep or crate is None:
            return Start(whole="real time")
        if not plan.first_tick:
            return Start(whole="a fault prevents the launch")
        self.run_to_snapshot(crate, plan.first_tick)
        if self._why_none:
            return Start(whole=f"{NO_SNAPSHOTS_PREFIX}{self._why_none}")
        return Start(continues=self._continue_before(plan.first_tick), events=self._trial.events)

    def run_to_snapshot(self, crate: WarmCrate, tick: int = 0) -> None:
        """Run the faultless rack as far as the last snapshot before a tick, if it can have one.

        Args:
            crate: Crate of the worker.
            tick: The tick. 0 for the first snapshot.
        """
        if not self._why_none:
            # Include the tick of the snapshot, so that it is taken.
            ticks = tick - tick % self._every + 1
            self.run(crate, ticks * self._config.clock_ns * 1e-9)

    def run(self, crate: WarmCrate, seconds: float | None, cores: Set[int] | None = None) -> Trial:
        """Return the faultless trial, run at least for a time in this crate.

        The trial continues from its last snapshot if it is not long enough yet.

        Args:
            crate: Crate of the worker, which keeps the snapshots.
            seconds: Simulated time in s after which the run ends. None to run until the task ends.
            cores: Cores on which the boards may run. None for those given to the constructor.
        """
        if self._crate is not crate:
            self._crate = crate
            self._reached = 0
        ticks = sys.maxsize if seconds is None else round(seconds * 1e9 / self._config.clock_ns)
        if self._reached >= ticks:
            return self._trial
        start = Start()
        if not self._why_none:
            start = Start(
                continues=self._continue_before(self._reached) if self._reached else None,
                snapshots=SnapshotPolicy(part=0, every=self._every),
                events=self._trial.events,
            )
        self._trial = run_trial(
            self._config,
            NOMINAL,
            self.name,
            0,
            seconds,
            start=start,
            crate=crate,
            cores=self._cores if cores is None else cores,
        )
        self._reached = ticks
        reasons = (
            event.text.removeprefix(NO_SNAPSHOTS_PREFIX)
            for event in self._trial.events
            if event.text.startswith(NO_SNAPSHOTS_PREFIX)
        )
        self._why_none = next(reasons, self._why_none)
        return self._trial

    def _continue_before(self, tick: int) -> Continuation:
        """Request to continue from the last snapshot at or before a tick."""
        return Continuation(tick, len(self._config.fault), len(self._config.command))
