"""Faultless lockstep run, from whose snapshots trials continue.

Until its first fault, a trial equals this run bit for bit. The trial therefore continues from the
last snapshot before the fault and takes over the earlier events of this run. Its verdict is the
same as if it had begun at tick 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.boards.errors import NO_SNAPSHOTS_PREFIX
from rack.boards.events import OF_LAUNCH, Event
from rack.boards.wiring import Continuation, SnapshotPolicy
from rack.tools.faults.campaigns.plan import Plan

EVERY_S = 2.0
"""Simulated time between two snapshots. On average a trial repeats half of it."""


@dataclass(frozen=True)
class Start:
    """Starting point of a trial.

    Attributes:
        tick: Tick before which the trial starts.
        whole: Why the trial does not continue from a snapshot. Empty if it does, and for the
            faultless run.
        continues: The snapshot from which to continue. None for a whole run.
        events: Events of the faultless run before the start.
    """

    tick: int = 0
    whole: str = ""
    continues: Continuation | None = None
    events: tuple[Event, ...] = ()

    def resolve_snapshot(self, tick: int) -> Start:
        """Return a copy with the tick of the snapshot that was used and only the events before it.

        Args:
            tick: Tick at which the trial actually began.
        """
        if self.continues is None:
            return self
        earlier_events = (
            event for event in self.events if event.tick < tick and event.kind not in OF_LAUNCH
        )
        return Start(tick, "", self.continues, tuple(earlier_events))


class BaseRack:
    """The faultless rack of one worker process.

    Its snapshots belong to the crate of the worker. Trials of the worker use the same rack name.
    """

    def __init__(self, config: RackConfig, name: str) -> None:
        self.name = name
        self._config = config
        self._crate: WarmCrate | None = None
        self._events: Sequence[Event] = ()
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
        if not self._why_none and self._crate is not crate:
            self._run_faultless(crate, seconds)
        if self._why_none:
            return Start(whole=f"{NO_SNAPSHOTS_PREFIX}{self._why_none}")
        continuation = Continuation(
            plan.first_tick, len(self._config.fault), len(self._config.command)
        )
        return Start(continues=continuation, events=tuple(self._events))

    def _run_faultless(self, crate: WarmCrate, seconds: float | None) -> None:
        """Run the faultless rack in a crate, which keeps its snapshots."""
        config = Plan(0, "nominal", lockstep=True).to_config(self._config, self.name)
        every = max(1, round(EVERY_S * 1e9 / config.clock_ns))
        with Rack(config, crate=crate, snapshots=SnapshotPolicy(part=0, every=every)) as rack:
            rack.run(seconds)
        self._crate = crate
        self._events = rack.events
        reasons = (
            event.text.removeprefix(NO_SNAPSHOTS_PREFIX)
            for event in rack.events
            if event.text.startswith(NO_SNAPSHOTS_PREFIX)
        )
        self._why_none = next(reasons, "")
