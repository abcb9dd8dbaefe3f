"""The faultless rack in lockstep from which trials go on.

Until its first fault a trial is this rack, bit for bit. So it goes on from the last snapshot before
that, with the events until then, and its verdict is that of a whole trial.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.boards.errors import UNKEPT
from rack.boards.events import Event
from rack.boards.wiring import Continuation, SnapshotPolicy
from rack.tools.faults.campaigns.plan import Plan

EVERY_S = 2.0
"""Simulated time between two snapshots: a trial goes through half of it, on the average, again."""
OF_LAUNCH = ("launch", "ready", "start")
"""Kinds of events that each launch has anew."""


@dataclass(frozen=True)
class Start:
    """Where a trial starts: before `tick`, with the `events` until then.

    `whole` says why it starts at its beginning; empty for one that does not, and for the faultless
    run.
    """

    tick: int = 0
    whole: str = ""
    continues: Continuation | None = None
    events: tuple[Event, ...] = ()

    def at(self, tick: int) -> Start:
        """Return the start at the snapshot that was found."""
        if self.continues is None:
            return self
        before = (e for e in self.events if e.tick < tick and e.kind not in OF_LAUNCH)
        return Start(tick, "", self.continues, tuple(before))


class BaseRack:
    """The faultless rack of one process that makes trials: its snapshots are in that process's
    crate, and its trials have its `name`.
    """

    def __init__(self, config: RackConfig, name: str) -> None:
        self.name = name
        self._config = config
        self._crate: WarmCrate | None = None
        self._events: Sequence[Event] = ()
        self._why_none = config.outside

    def start_of(self, plan: Plan, crate: WarmCrate | None, seconds: float | None) -> Start:
        """Return where the trial of a plan starts; run the base, for `seconds` where no task ends
        it, if this crate has none.
        """
        if not (plan.faults or plan.kills):
            return Start()
        if not plan.lockstep or crate is None:
            return Start(whole="real time")
        if not plan.first:
            return Start(whole="a fault prevents the launch")
        if not self._why_none and self._crate is not crate:
            self._run(crate, seconds)
        if self._why_none:
            return Start(whole=f"{UNKEPT}{self._why_none}")
        known = Continuation(plan.first, len(self._config.fault), len(self._config.command))
        return Start(continues=known, events=tuple(self._events))

    def _run(self, crate: WarmCrate, seconds: float | None) -> None:
        """Run the base in a crate, which keeps its snapshots."""
        config = Plan(0, "nominal", lockstep=True).config(self._config, self.name)
        every = max(1, round(EVERY_S * 1e9 / config.clock_ns))
        with Rack(config, crate=crate, snapshots=SnapshotPolicy(part=0, every=every)) as rack:
            rack.run(seconds)
        self._crate = crate
        self._events = rack.events
        found = (e.text.removeprefix(UNKEPT) for e in rack.events if e.text.startswith(UNKEPT))
        self._why_none = next(found, "")
