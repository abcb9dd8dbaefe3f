"""The Rack: launches the boards of a config, supervises them, and ends them."""

from __future__ import annotations

import atexit
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Self

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import FaultTable
from rack.backplane.operator_table import OperatorTable, Request, RequestEntry
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System
from rack.boards.config.commands import asked, request
from rack.boards.config.loader import load
from rack.boards.config.resolved import Resolved, classes, resolve
from rack.boards.config.schema import RackConfig
from rack.boards.crate.clean import remove_dead, remove_own
from rack.boards.crate.launch_checks import (
    check_open_files,
    check_realtime,
    list_launch_notes,
)
from rack.boards.crate.line import CrateLine
from rack.boards.crate.neighbours import conflicts, holders, placed
from rack.boards.crate.patience import await_opened
from rack.boards.crate.requests import CellConfig, HogWiring, Open, PowerOff, PowerOn, Preload
from rack.boards.crate.supervisor import STOP_S, Supervisor
from rack.boards.errors import ConfigError, Mistake, SnapshotError
from rack.boards.events import CONTINUES, Event, Journal, Outcome
from rack.boards.faults.kind import KINDS
from rack.boards.wiring import Continuation, Entries, SnapshotPolicy

LAUNCH_S = 60.0
"""Time limit of each step of the launch: to preload one class, which may compile code, or to ready
all boards."""
TO_SHARE = "stop that rack, choose other cores, or use --share"
LEAVE_S = 2.0
"""Time for the boards to end by themselves."""
LOOK_S = 0.5
"""Time between two looks at boards that do not ask for one."""


class Rack:
    """A rack of boards. Use it as a context: `with Rack.from_file("nasrem") as rack:
    rack.run(seconds=10)`.

    `on_event` is called with every `Event`, in the caller's process; of a run in the background, in
    its thread. Without `share`, a launch is refused if another rack's real-time boards occupy a
    core that this one requests. A `crate` that was started earlier saves time. With `entries`, by
    adapter and port, host boards are not started, and other racks not met: what a recorded run
    wrote there enters instead. `snapshots`: those that it takes in lockstep. `continues`: the
    snapshot of its `crate` from which it goes on. `requests`: an operator's commands besides the
    config's, and those that wait in the snapshot, by their ticks. `begins_at`: the tick of that
    snapshot; -1 without one. `repeats`: the rack whose run
    this repeats under a name of its own; levels see the name of that.
    """

    def __init__(
        self,
        config: RackConfig,
        on_event: Callable[[Event], None] | None = None,
        share: bool = True,
        crate: CrateLine | None = None,
        entries: Mapping[str, Entries] | None = None,
        snapshots: SnapshotPolicy | None = None,
        continues: Continuation | None = None,
        requests: Sequence[Request] = (),
        repeats: str = "",
    ) -> None:
        self.config = config
        self._repeats = repeats
        self._requests = requests
        self._entries = entries
        self._snapshots = snapshots
        self._continues = continues
        self.begins_at = -1
        self._share = share
        self._journal = Journal(on_event)
        self._crate = crate
        self._launched: Supervisor | None = None
        self._thread: Thread | None = None
        self._failed: BaseException | None = None

    @property
    def events(self) -> list[Event]:
        """The events so far."""
        return self._journal.events

    @property
    def segment(self) -> Segment:
        """Memory of the rack, from its launch on."""
        return self._supervisor.segment

    @property
    def outcome(self) -> Outcome | None:
        """How the run ended; None: it has not."""
        return None if self._launched is None else self._launched.outcome

    @classmethod
    def from_file(cls, name_or_path: str | Path, overrides: Sequence[str] = ()) -> Self:
        """Return the rack of a config, by name or path. Raises `ConfigError` with every mistake."""
        return cls(load(str(name_or_path), overrides))

    def __enter__(self) -> Self:
        if self._launched is None:
            self.launch()
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        self.close()
        if kind is None:
            # It raises what ended the supervision.
            self.wait(0)

    def launch(self) -> None:
        """Power on every board except the clock, and wait until all have passed their self-tests.

        Raises `ConfigError` for an invalid config or occupied cores, `SegmentError` if the name is
        in use, and `LaunchError` if a board fails; in each case nothing is left behind.
        """
        try:
            self._power_on()
        except BaseException:
            self.close()
            raise

    def _power_on(self) -> None:
        held = holders(self.config.name)
        self.config, moved = placed(self.config, held)
        shared = conflicts(self.config, held)
        if shared and not self._share:
            raise ConfigError([Mistake(line, None, TO_SHARE) for line in shared])
        # Reported first, because the next steps take long on occupied cores.
        for note in shared:
            self._journal.add("waiting", "", note)
        self._crate = crate = self._crate or CrateLine()
        # The crate imports while this process resolves the config: with two cores this saves 0.5 s.
        # A level's module may have ended it: then resolving says which.
        crate.ask(Preload(classes(self.config), tuple(sys.path), cell_of(self.config)))
        plan = resolve(self.config).for_run(self._repeats, self._entries)
        if self._snapshots is not None:
            # In a replay what came from outside is in the wiring.
            why = "" if plan.is_replay else self.config.outside
            if self.config.clock.mode != "lockstep":
                why = "they are taken in lockstep; add --lockstep"
            if why:
                raise SnapshotError(f"rack '{self.config.name}' has no snapshots: {why}")
        check_open_files(plan)
        remove_dead(self.config.name)
        segment = Segment.create(plan.layout, self.config.text(), plan.published.text())
        self._journal.segment = segment
        self._launched = supervisor = Supervisor(segment, plan, crate, self._journal)
        words = segment.words
        clock = self.config.clock
        # The latch is set at first: until it is reset, the brakes stay engaged.
        words[System.EMERGENCY_STOP] = 1
        words[System.LOCKSTEP] = clock.mode == "lockstep"
        words[System.PERIOD_NS] = round(self.config.clock_ns / clock.speed)
        if (wanted := self._snapshots) is not None:
            words[System.SNAPSHOT_PART] = wanted.part
            words[System.SNAPSHOT_EVERY] = wanted.every
            words[System.SNAPSHOT_AT] = 0 if wanted.at is None else wanted.at + 1
        before = None if self._continues is None else self._continues.tick
        crate.send(Open(self.config.name, plan.crate_priority, before))
        self._journal.add(
            "launch", "", f"{len(plan.tasks)} tasks, segment of {len(segment.bytes)} bytes"
        )
        self.begins_at = await_opened(crate, self._journal, LAUNCH_S)
        if before is not None and self.begins_at < 0:
            raise SnapshotError(f"rack '{self.config.name}': no snapshot before tick {before}")
        for wiring in plan.tasks:
            crate.send(PowerOn(wiring.task, wiring))
        supervisor.await_ready(LAUNCH_S)
        check_realtime(plan, segment)
        self._inject(plan, crate)
        for note in (*moved, *list_launch_notes(plan, segment)):
            self._journal.add("ready", "", note)

    def _inject(self, plan: Resolved, crate: CrateLine) -> None:
        """Fill the tables with the config's faults and commands; start the faults that are
        processes.
        """
        table = FaultTable(self.segment)
        before = self._continues or Continuation(0)
        for injection in plan.faults[before.faults :]:
            entry = table.add(injection)
            if KINDS[injection.kind].where == "core":
                crate.send(PowerOn(f"hog {entry.index}", HogWiring(entry.index)))
        desk = OperatorTable(self.segment)
        # A snapshot has those that waited, and leases, of which no client can be here.
        for lease in desk.leased():
            desk.release(lease)
        for wanted in (*plan.commands[before.commands :], *desk.lacking(self._requests)):
            desk.add(wanted)

    def follow(self, events: Iterable[Event]) -> None:
        """Take over the events of the run that this one continues, from before its snapshot: the
        outcome counts them.
        """
        self._journal.events.extend(events)

    def start(self, seconds: float | None = None) -> None:
        """Power on the clock, which begins the run. It lasts `seconds` of simulated time, or until
        the task ends.
        """
        supervisor = self._supervisor
        plan = supervisor.plan
        clock = plan.clock(seconds)
        if self._snapshots is not None or self._continues is not None:
            # Not in the clock's wiring: what goes on from a snapshot may end at another tick.
            stop = max(clock.stop_tick, self.begins_at) if clock.stop_tick else 0
            self.segment.words[System.STOP_TICK] = stop
            clock = replace(clock, stop_tick=0)
        if self._continues is None:
            supervisor.reset_latch()
        else:
            # The latch is as it was, and what was raised before is in the other run's events.
            supervisor.is_armed = True
            supervisor.alarms.drain()
            tick = self.begins_at
            self._journal.add("launch", "", f"continues before tick {tick}", CONTINUES, tick=tick)
            for board, lost in self._continues.losses:
                if lost < tick:
                    supervisor.policy.admit(board, lost)
        supervisor.recovery.start(clock, plan)
        self._journal.add("start", CLOCK, self.config.clock.mode)

    def run(self, seconds: float | None = None) -> Outcome:
        """Run for `seconds` of simulated time, or until the task ends; return the outcome."""
        self.start(seconds)
        while (outcome := self.outcome) is None:
            self.watch(LOOK_S)
        return outcome

    def run_in_background(self, seconds: float | None = None) -> None:
        """Begin to run as `run` does, and return: a thread supervises the boards until the run is
        over, or the rack closed.

        Whatever holds the interpreter's lock for long delays restarts, not the boards.
        """
        self.start(seconds)
        # A notebook's rack may never be closed; the interpreter does not wait for a daemon.
        atexit.register(self.close)
        self._thread = Thread(target=self._supervise, daemon=True)
        self._thread.start()

    def _supervise(self) -> None:
        try:
            while self.watch(LOOK_S):
                continue
        except BaseException as error:
            # Nobody watches the boards any more. `wait` and the end of the context show it.
            self._failed = error
            self._supervisor.end_boards()

    def wait(self, timeout_s: float | None = None) -> Outcome | None:
        """Wait until the run in the background is over; return its outcome, None if it goes on.

        Raises what ended its supervision, such as an error of `on_event`.
        """
        if self._thread is not None:
            self._thread.join(timeout_s)
        if self._failed is not None:
            raise self._failed
        return self.outcome

    def watch(self, timeout_s: float) -> bool:
        """Supervise the boards for `timeout_s` or until the run is over; return False when it is
        over.
        """
        return self._supervisor.watch(timeout_s)

    def stop(self, why: str = "stopped by its program") -> None:
        """End the run at the next tick. May be called at any time, even from a signal handler."""
        self._supervisor.stop(why)

    def command(
        self, level: str, what: str, tick: int | None = None, **goal: object
    ) -> RequestEntry:
        """Issue an operator command to a level, at `tick` or at once; return its entry in the
        operator table.

        `what` and `goal` are as in a `[[command]]` table: `rack.command("servo", "setpoint",
        joints=(...))`. Raises `ConfigError` with every mistake, `OperatorTableError` if too many
        are pending.
        """
        wanted = asked({"level": level, "what": what, "tick": tick, **goal})
        plan = self._supervisor.plan
        found = request(wanted, self.config, plan.published.levels, plan.layout)
        return OperatorTable(self.segment).add(found)

    def close(self) -> None:
        """End everything: no process and no segment of this rack is left."""
        atexit.unregister(self.close)
        if (crate := self._crate) is None:
            return
        if self._thread is not None and self.outcome is None:
            self.stop()
            self._thread.join(STOP_S + LEAVE_S)
        self._crate = None
        leave_s = 0.0
        try:
            if (launched := self._launched) is not None:
                launched.end_boards()
                tasks = launched.plan.layout.tasks
                lost = any(self.segment.block(task.name)[Block.LOST] for task in tasks)
                if lost or launched.recovery.given_up:
                    crate.ask(PowerOff())
                # A crate without boards may still be importing: do not wait for it.
                leave_s = LEAVE_S if launched.pids else 0.0
            crate.close(leave_s)
        finally:
            # By name: the launch may have been interrupted before the segment was known.
            remove_own(self.config.name)
            if self._launched is not None:
                self.segment.close()

    @property
    def _supervisor(self) -> Supervisor:
        assert self._launched is not None, "the rack is launched"
        return self._launched


def cell_of(config: RackConfig) -> CellConfig | None:
    """Return what the crate needs to compile the cell of a rack; None without an arm."""
    return None if config.robot is None else CellConfig(config.robot, config.scene, config.clock_ns)
