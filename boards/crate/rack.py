"""The Rack: launches the boards of a config, supervises them, and ends them."""

from __future__ import annotations

import atexit
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import wait
from pathlib import Path
from threading import Thread
from typing import Self

from rack.backplane.address_map import CLOCK
from rack.backplane.checked import pick
from rack.backplane.errors import DamageError, EmergencyStopError
from rack.backplane.fault_table import FaultTable
from rack.backplane.lines import UtilityLines
from rack.backplane.mailbox.history import digest
from rack.backplane.operator_table import OperatorTable, Request, RequestEntry
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Block, Run, System, TaskState
from rack.boards.config.commands import asked, request
from rack.boards.config.outside import outside
from rack.boards.config.resolved import classes, load, resolve
from rack.boards.config.schema import RackConfig
from rack.boards.crate.alarm_events import AlarmWatch
from rack.boards.crate.clean import remove_dead, remove_own
from rack.boards.crate.heartbeat import Heartbeat
from rack.boards.crate.lateness import judge_lost_cycles
from rack.boards.crate.line import CrateLine
from rack.boards.crate.neighbours import conflicts, holders, placed
from rack.boards.crate.patience import Patience, RackAwaited, await_opened
from rack.boards.crate.recovery import HostBoards, LostBoards, Recovery, Supervision
from rack.boards.crate.requests import (
    CellConfig,
    Ended,
    Forked,
    ForkFailed,
    HogWiring,
    Open,
    PowerOff,
    PowerOn,
    Preload,
)
from rack.boards.errors import (
    UNKEPT,
    ConfigError,
    LaunchError,
    Mistake,
    SnapshotError,
)
from rack.boards.events import (
    CONTINUES,
    SUCCESSES,
    Cause,
    Ending,
    Event,
    Journal,
    Outcome,
    brakings,
)
from rack.boards.faults.kind import KINDS
from rack.boards.wiring import Continuation, Entries, SnapshotPolicy

LAUNCH_S = 60.0
"""Time limit of each step of the launch: to preload one class, which may compile code, or to ready
all boards."""
UP = (TaskState.READY, TaskState.RUNNING)
TO_SHARE = "stop that rack, choose other cores, or use --share"
LEAVE_S = 2.0
"""Time for the boards to end by themselves."""
MOST_TICKS = 1 << 48
"""No run has so many."""
LAST_S = 0.2
"""Time for the boards to finish their last cycles before these are counted."""
STOP_S = 0.8
"""Time for the clock to end the run after a stop request, before the Rack does so."""
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
        self.segment: Segment
        self.outcome: Outcome | None = None
        self._journal = Journal(on_event)
        self._crate = crate
        self._pids: dict[str, int] = {}
        self._losses = LostBoards(self._journal)
        self._is_armed = False
        self._why_stopped = ""
        self._stop_by: float | None = None
        self._supervisor: Thread | None = None
        self._failed: BaseException | None = None

    @property
    def events(self) -> list[Event]:
        """The events so far."""
        return self._journal.events

    @classmethod
    def from_file(cls, name_or_path: str | Path, overrides: Sequence[str] = ()) -> Self:
        """Return the rack of a config, by name or path. Raises `ConfigError` with every mistake."""
        return cls(load(str(name_or_path), overrides))

    def __enter__(self) -> Self:
        if not hasattr(self, "segment"):
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
        is_copied = self._snapshots is not None
        plan = resolve(self.config).for_run(self._repeats, self._entries, is_copied)
        self._plan = plan
        if is_copied and (why := self._why_without_snapshots()):
            raise SnapshotError(f"rack '{self.config.name}' has no snapshots: {why}")
        plan.check_files()
        remove_dead(self.config.name)
        self.segment = self._journal.segment = Segment.create(
            plan.layout, self.config.text(), plan.published.text()
        )
        words = self.segment.words
        clock = self.config.clock
        # The latch is set at first: until it is reset, the brakes stay engaged.
        words[System.EMERGENCY_STOP] = 1
        words[System.LOCKSTEP] = clock.mode == "lockstep"
        words[System.PERIOD_NS] = round(self.config.clock_ns / clock.speed)
        wanted = self._snapshots or SnapshotPolicy(part=0)
        words[System.SNAPSHOT_PART] = wanted.part
        words[System.SNAPSHOT_EVERY] = wanted.every
        words[System.SNAPSHOT_AT] = 0 if wanted.at is None else wanted.at + 1
        before = None if self._continues is None else self._continues.tick
        crate.send(Open(self.config.name, plan.crate_priority, before))
        self._journal.add(
            "launch", "", f"{len(plan.tasks)} tasks, segment of {len(self.segment.bytes)} bytes"
        )
        self.begins_at = await_opened(crate, self._journal, LAUNCH_S)
        if before is not None and self.begins_at < 0:
            raise SnapshotError(f"rack '{self.config.name}': no snapshot before tick {before}")
        for wiring in plan.tasks:
            crate.send(PowerOn(wiring.task, wiring))
        self._await_ready()
        plan.check_realtime(self.segment)
        self._inject()
        for note in (*moved, *plan.notes(self.segment)):
            self._journal.add("ready", "", note)

    def _await_ready(self) -> None:
        patience = Patience(self._journal, LAUNCH_S)
        while absent := [t.name for t in self._plan.layout.tasks if self._state(t.name) not in UP]:
            self._listen(patience.left_s)
            if self._losses.faults:
                printed = self._line.printed()
                raise LaunchError("\n".join(printed) or self._losses.faults[0])
            if patience.is_over:
                raise LaunchError(f"boards {', '.join(absent)}: not ready within {LAUNCH_S:g} s")
            patience.report(f"boards {', '.join(absent)} are starting")

    def _why_without_snapshots(self) -> str:
        """Return why this rack has none; empty: it has."""
        if self.config.clock.mode != "lockstep":
            return "they are taken in lockstep; add --lockstep"
        # In a replay what came from outside is in the wiring.
        return "" if self._plan.is_replay else outside(self.config)

    def _inject(self) -> None:
        """Fill the tables with the config's faults and commands; start the faults that are
        processes."""
        table = FaultTable(self.segment)
        before = self._continues or Continuation(0)
        for injection in self._plan.faults[before.faults :]:
            entry = table.add(injection)
            if KINDS[injection.kind].where == "core":
                self._line.send(PowerOn(f"hog {entry.index}", HogWiring(entry.index)))
        desk = OperatorTable(self.segment)
        # A snapshot has those that waited, and leases, of which no client can be here.
        for lease in desk.leased():
            desk.release(lease)
        for wanted in (*self._plan.commands[before.commands :], *desk.lacking(self._requests)):
            desk.add(wanted)

    def follow(self, events: Iterable[Event]) -> None:
        """Take over the events of the run that this one continues, from before its snapshot: the
        outcome counts them."""
        self._journal.events.extend(events)

    def start(self, seconds: float | None = None) -> None:
        """Power on the clock, which begins the run. It lasts `seconds` of simulated time, or until
        the task ends."""
        clock = self._plan.clock(seconds)
        if self._snapshots is not None or self._continues is not None:
            # Not in the clock's wiring: what goes on from a snapshot may end at another tick.
            stop = max(clock.stop_tick, self.begins_at) if clock.stop_tick else 0
            self.segment.words[System.STOP_TICK] = stop
            clock = replace(clock, stop_tick=0, is_copied=self._snapshots is not None)
        self._ending = Ending(self.segment, clock.ends_run, clock.silent)
        wirings = {wiring.task: wiring for wiring in self._plan.tasks}
        supervision = Supervision(self.config, self._plan.layout)
        for board, tick in (self._continues or Continuation(0)).losses:
            if tick < self.begins_at:
                supervision.admit(board, tick)
        self._recovery = Recovery(self.segment, supervision, {**wirings, CLOCK: clock}, self._line)
        self._hosts = HostBoards(
            self.segment, self._plan.hosts, supervision, self._line, self._journal
        )
        self._losses.begin(self._recovery, self._hosts)
        self._alarms = AlarmWatch(self.segment)
        self._heartbeat = Heartbeat(self.segment)
        self._awaited = RackAwaited(self.segment, self._journal)
        if self._continues is None:
            self._reset_latch()
        else:
            # The latch is as it was, and what was raised before is in the other run's events.
            self._is_armed = True
            self._alarms.drain()
            tick = self.begins_at
            self._journal.add("launch", "", f"continues before tick {tick}", CONTINUES, tick=tick)
        self._line.ask(PowerOn(CLOCK, clock))
        self._hosts.start()
        self._journal.add("start", CLOCK, self.config.clock.mode)

    def _reset_latch(self) -> None:
        """Reset the emergency stop on behalf of the caller, as soon as all inputs permit it."""
        with suppress(EmergencyStopError):
            UtilityLines(self.segment).reset_emergency_stop()
            self._is_armed = True

    def run(self, seconds: float | None = None) -> Outcome:
        """Run for `seconds` of simulated time, or until the task ends; return the outcome."""
        self.start(seconds)
        while self.watch(LOOK_S):
            continue
        assert self.outcome is not None
        return self.outcome

    def run_in_background(self, seconds: float | None = None) -> None:
        """Begin to run as `run` does, and return: a thread supervises the boards until the run is
        over, or the rack closed.

        Whatever holds the interpreter's lock for long delays restarts, not the boards.
        """
        self.start(seconds)
        # A notebook's rack may never be closed; the interpreter does not wait for a daemon.
        atexit.register(self.close)
        self._supervisor = Thread(target=self._supervise, daemon=True)
        self._supervisor.start()

    def _supervise(self) -> None:
        try:
            while self.watch(LOOK_S):
                continue
        except BaseException as error:
            # Nobody watches the boards any more. `wait` and the end of the context show it.
            self._failed = error
            self._end_boards()

    def wait(self, timeout_s: float | None = None) -> Outcome | None:
        """Wait until the run in the background is over; return its outcome, None if it goes on.

        Raises what ended its supervision, such as an error of `on_event`.
        """
        if self._supervisor is not None:
            self._supervisor.join(timeout_s)
        if self._failed is not None:
            raise self._failed
        return self.outcome

    def watch(self, timeout_s: float) -> bool:
        """Supervise the boards for `timeout_s` or until the run is over; return False when it is
        over."""
        deadline = time.monotonic() + timeout_s
        while self.outcome is None:
            self._listen(min(deadline, self._stop_by or deadline) - time.monotonic())
            if self._why_stopped and self._stop_by is None:
                self._stop_by = time.monotonic() + STOP_S
                self._journal.add("stop", "", self._why_stopped)
            self._record_printed()
            for rung in self._alarms.drain():
                # Record the event of an alarm, and kill a process that hangs.
                self._journal.keep(rung.event)
                if rung.alarm == Alarm.HANG:
                    task = pick(self._plan.layout.tasks, rung.subject, "task")
                    self._recovery.end_hanging(task.name)
                elif rung.alarm == Alarm.CLOCK_STOPPED and rung.subject == self._pids.get(CLOCK):
                    # Only the clock that was reported: its successor may be running by now.
                    self._recovery.end_hanging(CLOCK)
            for board in self._heartbeat.hanging():
                self._journal.add(
                    "detection", "rack", f"'{board}' is not responding", "hang", subject=board
                )
                self._recovery.end_hanging(board)
            self._awaited.look()
            self._recovery.advance()
            self._hosts.look()
            if not self._is_armed:
                self._reset_latch()
            is_late = self._stop_by is not None and time.monotonic() >= self._stop_by
            if self._is_stopped or self._losses.is_beyond_help or is_late:
                self._end()
            if time.monotonic() >= deadline:
                break
        return self.outcome is None

    def stop(self, why: str = "stopped by its program") -> None:
        """End the run at the next tick. May be called at any time, even from a signal handler."""
        self._why_stopped = self._why_stopped or why
        self.segment.words[System.STOP_REQUEST] = 1
        os.eventfd_write(self._line.attention, 1)

    def _record_printed(self) -> None:
        for line in self._line.printed():
            self._journal.add("ready" if line.startswith(UNKEPT) else "printed", "", line)

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
        plan = self._plan
        found = request(wanted, self.config, plan.published.levels, plan.layout)
        return OperatorTable(self.segment).add(found)

    def _listen(self, timeout_s: float) -> None:
        """Wait for the crate or an alarm, at most `timeout_s`."""
        line = self._line.line
        attention = self._line.attention
        for ready in wait([line, attention], timeout_s):
            if ready == attention:
                os.eventfd_read(attention)
            else:
                self._receive()

    def _receive(self) -> None:
        message = self._line.receive()
        if isinstance(message, ForkFailed):
            if self.segment.words[System.STATE] == Run.STARTING:
                raise LaunchError(message.why)
            self._journal.add("printed", "", message.why)
            message = message.end
        match message:
            case Forked(name, pid):
                self._pids[name] = pid
            case Ended(name, _, status) as end:
                self._pids.pop(name, None)
                is_board = name == CLOCK or name in self.segment.map.blocks
                is_over = self._is_stopped or self.outcome is not None
                if is_board and not (is_over and status == 0):
                    # Of one that died before the end the policy decides, however late this is read.
                    died_before = name != CLOCK and self.segment.block(name)[Block.LOST]
                    is_late = self._is_stopped and not died_before
                    self._losses.lose(end, is_late, self._record_printed)
            case None:
                self._losses.lose_crate()

    def _end(self) -> None:
        """Record the end of the run (cause, ticks, digest) and let the boards end."""
        for rung in self._alarms.drain():
            self._journal.keep(rung.event)
        words = self.segment.words
        stop = words[System.STOP_TICK] or words[System.TICK] + 1
        if not 0 <= stop < MOST_TICKS:
            raise DamageError(f"a run of {stop} ticks")
        state, reason = self._ending.final_state()
        cause = self._cause()
        faults = self._losses.faults
        tick_ms = self.config.clock_ns * 1e-6
        found = brakings(self.events, stop, tick_ms)
        if cause in SUCCESSES:
            faults += self._ending.latched()
        if cause == "time over":
            faults += self._ending.held(self.events, found, stop * tick_ms)
        objects = self._ending.ends(self._plan.goals)
        if cause == "task done":
            # Written so that NaN is too far.
            faults += [str(end) for end in objects if not end.off_mm <= end.tolerance_mm]
        self._end_boards()
        # Wait until boards have finished the cycles that they have begun, at most LAST_S.
        patience = Patience(self._journal, LAST_S)
        while any(map(self._is_cycling, self._pids)) and not patience.is_over:
            self._listen(patience.left_s)
        late, excused = judge_lost_cycles(self.segment, self.config, stop)
        self.outcome = Outcome(
            cause=cause,
            ticks=stop,
            state=state,
            reason=reason,
            digest=digest(self.segment, stop),
            faults=(*faults, *late),
            brakings=found,
            objects=objects,
            excused=tuple(excused),
        )
        self._journal.add("end", "", f"{cause} after {stop} ticks{': ' + reason if reason else ''}")

    def _is_cycling(self, name: str) -> bool:
        if self._losses.is_beyond_help or name not in self.segment.map.blocks:
            return False
        block = self.segment.block(name)
        return block[Block.DONE] < block[Block.RELEASED] and not block[Block.LOST]

    def _cause(self) -> Cause:
        if self._losses.given_up:
            return "board lost"
        # A stop may also come from another process, by this word.
        if self.segment.words[System.STOP_REQUEST]:
            return "stopped"
        return self._ending.cause()

    def close(self) -> None:
        """End everything: no process and no segment of this rack is left."""
        atexit.unregister(self.close)
        if self._crate is None:
            return
        if self._supervisor is not None and self.outcome is None:
            self.stop()
            self._supervisor.join(STOP_S + LEAVE_S)
        crate = self._crate
        self._crate = None
        try:
            if hasattr(self, "segment"):
                self._end_boards()
            if self._losses.given_up or (
                hasattr(self, "segment")
                and any(self.segment.block(t.name)[Block.LOST] for t in self._plan.layout.tasks)
            ):
                crate.ask(PowerOff())
            # A crate without boards may still be importing: do not wait for it.
            crate.close(LEAVE_S if self._pids else 0)
        finally:
            # By name: the launch may have been interrupted before `segment` was set.
            remove_own(self.config.name)
            if hasattr(self, "segment"):
                self.segment.close()

    @property
    def _is_stopped(self) -> bool:
        return self.segment.words[System.STATE] == Run.STOPPED

    def _end_boards(self) -> None:
        """Declare the run over, to the clock and the boards."""
        self.segment.words[System.STOP_REQUEST] = 1
        self.segment.words[System.STATE] = Run.STOPPED

    def _state(self, task: str) -> int:
        return self.segment.block(task)[Block.STATE]

    @property
    def _line(self) -> CrateLine:
        assert self._crate is not None, "the rack is launched"
        return self._crate


def cell_of(config: RackConfig) -> CellConfig | None:
    """Return what the crate needs to compile the cell of a rack; None without an arm."""
    return None if config.robot is None else CellConfig(config.robot, config.scene, config.clock_ns)
