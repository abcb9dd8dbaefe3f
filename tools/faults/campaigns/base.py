"""Faultless lockstep run, from whose snapshots trials continue.

Until its first fault, a trial equals this run bit for bit. The trial therefore continues from the
last snapshot before the fault and takes over the earlier events of this run. Its verdict is the
same as if it had begun at tick 0.
"""

from __future__ import annotations

from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.boards.errors import NO_SNAPSHOTS_PREFIX
from rack.boards.wiring import Continuation, SnapshotPolicy
from rack.tools.faults.campaigns.plan import NOMINAL, Plan
from rack.tools.faults.campaigns.trial import Start, Trial, run_trial

EVERY_S = 2.0
"""Simulated time between two snapshots. On average a trial repeats half of it."""


class BaseRack:
    """The faultless rack of one worker process.

    Its snapshots belong to the crate of the worker. Trials of the worker use the same rack name.
    """

    def __init__(self, config: RackConfig, name: str) -> None:
        self.name = name
        self._config = config
        self._crate: WarmCrate | None = None
        self._trial = Trial(NOMINAL)
        self._why_none = config.outside_state

    def find_start(self, plan: Plan, crate: WarmCrate | None, seconds: float | None) -> Start:
        """Return the starting point of a trial. Run the faultless rack first if necessary.

        Args:
            plan: Plan of the trial.
            crate: Crate of the worker. None if it has none.
            seconds: Simulated time in s after which the faultless run ends if no task ends it.
        """
        if not (plan.faults or plan.kills):
            return Start()
        if not plan.lockstep or crate is None:
            return Start(whole="real time")
        if not plan.first_tick:
            return Start(whole="a fault prevents the launch")
        if not self._why_none:
            self.run_once(crate, seconds)
        if self._why_none:
            return Start(whole=f"{NO_SNAPSHOTS_PREFIX}{self._why_none}")
        continuation = Continuation(
            plan.first_tick, len(self._config.fault), len(self._config.command)
        )
        return Start(continues=continuation, events=self._trial.events)

    def run_once(self, crate: WarmCrate, seconds: float | None) -> Trial:
        """Return the faultless trial. Run it unless this crate has already run it."""
        if self._crate is not crate:
            every = max(1, round(EVERY_S * 1e9 / self._config.clock_ns))
            policy = None if self._why_none else SnapshotPolicy(part=0, every=every)
            start = Start(snapshots=policy)
            self._trial = run_trial(
                self._config, NOMINAL, self.name, 0, seconds, start=start, crate=crate
            )
            self._crate = crate
            reasons = (
                event.text.removeprefix(NO_SNAPSHOTS_PREFIX)
                for event in self._trial.events
                if event.text.startswith(NO_SNAPSHOTS_PREFIX)
            )
            self._why_none = next(reasons, self._why_none)
        return self._trial
