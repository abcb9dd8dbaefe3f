"""The Rack: launches the boards of a config, watches them, and takes everything down again."""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from rack.backplane import semaphores
from rack.backplane.address_map import CLOCK
from rack.backplane.alarms import Alarm
from rack.backplane.digest import digest
from rack.backplane.errors import EmergencyStopError
from rack.backplane.fault_table import FaultTable
from rack.backplane.lines import UtilityLines
from rack.backplane.operator_table import OperatorTable, RequestEntry
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Run, System, TaskState
from rack.boards.alarm_watch import AlarmWatch, Heard
from rack.boards.clean import remove_dead, remove_own
from rack.boards.config.commands import asked, request
from rack.boards.config.resolved import load, modules, resolve
from rack.boards.config.schema import RackConfig
from rack.boards.crate_line import CrateLine
from rack.boards.crate_messages import Ended, Forked, HogWiring, Open, Opened, PowerOff, PowerOn, Preload
from rack.boards.ending import Ending
from rack.boards.errors import ConfigError, LaunchError, Mistake
from rack.boards.events import Event
from rack.boards.faults.kind import KINDS
from rack.boards.heartbeat import Heartbeat
from rack.boards.journal import Journal
from rack.boards.neighbours import conflicts, holders, placed
from rack.boards.outcome import Cause, Outcome
from rack.boards.recovery import Recovery
from rack.boards.supervision import Supervision

LAUNCH_S = 60.0
"""Bound of the launch: a stranger's model with many meshes compiles for a while in every board."""
UP = (TaskState.READY, TaskState.RUNNING)
TO_SHARE = "stop that rack, choose other cores, or give --share"
LEAVE_S = 2.0
"""Bound of the boards' own end."""
STOP_S = 0.8
"""Bound of an orderly stop: a clock that has not ended the run by then is not waited for."""


class Rack:
    """A rack of boards. Use it as a context: `with Rack.from_file("nasrem") as rack: rack.run(seconds=10)`.

    `on_event` is called with every `Event`, in the process of the caller. Without `share` a launch is refused where
    another rack's real-time boards hold a core that this one asks for; a program that launches several places them.
    """

    def __init__(self, config: RackConfig, on_event: Callable[[Event], None] | None = None, share: bool = True) -> None:
        self.config = config
        self._share = share
        self.segment: Segment
        self.outcome: Outcome | None = None
        self._journal = Journal(on_event)
        self._crate: CrateLine | None = None
        self._pids: dict[str, int] = {}
        self._faults: list[str] = []
        self._is_armed = False
        self._is_beyond_help = False
        self._cause: Cause | None = None
        self._why_stopped = ""
        self._stop_by: float | None = None

    @property
    def events(self) -> list[Event]:
        """What has happened so far."""
        return self._journal.events

    @classmethod
    def from_file(cls, name_or_path: str | Path, overrides: Sequence[str] = ()) -> Self:
        """Return the rack of a config, by name or path. Raises `ConfigError` with every mistake."""
        return cls(load(str(name_or_path), overrides))

    def __enter__(self) -> Self:
        self.launch()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def launch(self) -> None:
        """Power on every board but the clock, and wait until all have passed their self-tests.

        Raises `ConfigError` for a config, or cores, that cannot be, `SegmentError` when the name is in use, and
        `LaunchError` when a board fails; nothing is left then.
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
        self._crate = crate = CrateLine()
        # The crate imports while the config is being wired: on two cores that is half a second saved.
        crate.send(Preload(modules(self.config), tuple(sys.path)))
        self._plan = plan = resolve(self.config)
        remove_dead(self.config.name)
        self.segment = self._journal.segment = Segment.create(plan.layout, self.config.text())
        self._set_words()
        semaphores.create(plan.layout)
        crate.send(Open(self.config.name, plan.crate_priority))
        self._journal.tell("launch", "", f"{len(plan.tasks)} tasks, segment of {len(self.segment.bytes)} bytes")
        self._expect(Opened)
        # The crate has them open and every board inherits them: with no name nothing can be left behind.
        semaphores.unlink(plan.layout)
        for wiring in plan.tasks:
            crate.send(PowerOn(wiring.task, wiring))
        self._await_ready()
        plan.check_realtime(self.segment)
        self._inject()
        for note in (*moved, *shared, *plan.notes(self.segment)):
            self._journal.tell("ready", "", note)

    def _set_words(self) -> None:
        words, clock = self.segment.words, self.config.clock
        # The latch starts set: whatever happens before the explicit reset, the arm's brakes stay closed.
        words[System.EMERGENCY_STOP] = 1
        words[System.LOCKSTEP] = clock.mode == "lockstep"
        words[System.PERIOD_NS] = round(self.config.clock_ns / clock.speed)

    def _await_ready(self) -> None:
        deadline = time.monotonic() + LAUNCH_S
        while absent := [t.name for t in self._plan.layout.tasks if self._state(t.name) not in UP]:
            self._listen(deadline - time.monotonic())
            if self._faults:
                raise LaunchError("\n".join(self._line.printed()) or self._faults[0])
            if time.monotonic() > deadline:
                raise LaunchError(f"boards {', '.join(absent)}: not ready within {LAUNCH_S:g} s")

    def _inject(self) -> None:
        """Fill the fault table with the config's faults; what is a process of its own is started here."""
        table = FaultTable(self.segment)
        for injection in self._plan.faults:
            entry = table.add(injection)
            if KINDS[injection.kind].where == "core":
                self._line.send(PowerOn(f"hog {entry.index}", HogWiring(entry.index)))
        desk = OperatorTable(self.segment)
        for wanted in self._plan.commands:
            desk.add(wanted)

    def start(self, seconds: float | None = None) -> None:
        """Power on the clock: the run begins. It lasts `seconds` of simulated time, or until the task ends."""
        clock = self._plan.clock(seconds)
        self._ending = Ending(self.segment, clock.ends_run, clock.silent)
        wirings = {wiring.task: wiring for wiring in self._plan.tasks}
        supervision = Supervision(self.config, self._plan.layout)
        self._recovery = Recovery(self.segment, supervision, {**wirings, CLOCK: clock}, self._line)
        self._alarms = AlarmWatch(self.segment, self.config)
        self._heartbeat = Heartbeat(self.segment)
        self._reset_latch()
        self._line.ask(PowerOn(CLOCK, clock))
        self._journal.tell("start", CLOCK, self.config.clock.mode)

    def _reset_latch(self) -> None:
        """Reset the emergency stop for the one who starts the run, as soon as every input is good."""
        with suppress(EmergencyStopError):
            UtilityLines(self.segment).reset_emergency_stop()
            self._is_armed = True

    def run(self, seconds: float | None = None) -> Outcome:
        """Run for `seconds` of simulated time, or until the task ends; return how it ended."""
        self.start(seconds)
        while self.watch(0.5):
            continue
        assert self.outcome is not None
        return self.outcome

    def watch(self, timeout_s: float) -> bool:
        """Watch the boards for that long, or until something happens; False when the run is over."""
        deadline = time.monotonic() + timeout_s
        while self.outcome is None:
            self._listen(min(deadline, self._stop_by or deadline) - time.monotonic())
            self._tell_stop()
            for line in self._line.printed():
                self._journal.tell("printed", "", line)
            for heard in self._alarms.drain():
                self._take(heard)
            for board in self._heartbeat.hanging():
                self._journal.tell("detection", "rack", f"'{board}' gives no sign of life", "hang", subject=board)
                self._recovery.end_hanging(board)
            self._recovery.advance()
            if not self._is_armed:
                self._reset_latch()
            is_late = self._stop_by is not None and time.monotonic() >= self._stop_by
            if self.segment.words[System.STATE] == Run.STOPPED or self._is_beyond_help or is_late:
                self._end()
            if time.monotonic() >= deadline:
                break
        return self.outcome is None

    def stop(self, why: str) -> None:
        """Have the run end at the next tick. May be called at any moment, by a signal's handler as well."""
        self._why_stopped = self._why_stopped or why
        self._cause = self._cause or "stopped"
        self.segment.words[System.STOP_REQUEST] = 1
        os.eventfd_write(self._line.attention, 1)

    def _tell_stop(self) -> None:
        if self._why_stopped and self._stop_by is None:
            self._stop_by = time.monotonic() + STOP_S
            self._journal.tell("stop", "", self._why_stopped)

    def command(self, level: str, what: str, tick: int | None = None, **goal: object) -> RequestEntry:
        """Hand an operator's command to a level, to be given at `tick`, or at once; return its entry in the table.

        `what` and `goal` are as in a `[[command]]` table: `rack.command("servo", "setpoint", joints=(...))`. Raises
        `ConfigError` with every mistake, `OperatorTableError` when too many wait.
        """
        wanted = asked({"level": level, "what": what, "tick": tick, **goal})
        return OperatorTable(self.segment).add(request(wanted, self.config, self._plan.layout))

    def _listen(self, timeout_s: float) -> None:
        """Hear the crate, and whoever rings, for that long or until there is something."""
        line, attention = self._line.line.fileno(), self._line.attention
        for fd in _wait([line, attention], timeout_s):
            if fd == attention:
                os.eventfd_read(attention)
            else:
                self._hear()

    def _hear(self) -> None:
        message = self._line.line.receive()
        match message:
            case Forked(name, pid):
                self._pids[name] = pid
            case Ended(name, _, status) as end:
                self._pids.pop(name, None)
                is_board = name == CLOCK or name in self.segment.map.blocks
                over = self.outcome is not None or self.segment.words[System.STATE] == Run.STOPPED
                if is_board and not (over and status == 0):
                    self._lose(end)
            case None:
                self._is_beyond_help = True
                text = "the crate ended, and every board with it"
                self._journal.tell("died", "crate", text, "died")
                self._give_up("crate", text)

    def _take(self, heard: Heard) -> None:
        """Make an event of an alarm, and act where it is the Rack that must."""
        self._journal.keep(heard.event)
        if heard.alarm == Alarm.HANG:
            self._recovery.end_hanging(self._plan.layout.tasks[heard.subject].name)
        elif heard.alarm == Alarm.CLOCK_STOPPED and heard.subject == self._pids.get(CLOCK):
            # Only the clock that was meant: the news may come when the next one has begun.
            self._recovery.end_hanging(CLOCK)

    def _expect(self, kind: type) -> None:
        there = _wait([self._line.line.fileno()], LAUNCH_S)
        if not there or not isinstance(self._line.line.receive(), kind):
            late = f"the crate did not open the segment in {LAUNCH_S:g} s"
            raise LaunchError("\n".join(self._line.printed()) or late)

    def _lose(self, end: Ended) -> None:
        """Tell of a board's end, and restart it or give it up."""
        text = f"board '{end.name}' ended: {_status(end.status)}"
        self._journal.tell("died", end.name, text, "died", end.seen_ns, end.tick)
        if not hasattr(self, "_recovery") or self.segment.words[System.STATE] == Run.STOPPED:
            self._give_up(end.name, text)
            return
        restart = self._recovery.lose(end.name, end.tick)
        if restart is None:
            self._is_beyond_help = end.name == CLOCK
            self._give_up(end.name, f"{text}; its restarts are used up")
        else:
            nth = f"restart {restart.number} of at most {restart.most} in {restart.within_s:g} s"
            self._journal.tell("reaction", end.name, nth, "restart")

    def _give_up(self, board: str, text: str) -> None:
        self._faults.append(text)
        self._cause = "board lost"
        self._journal.tell("reaction", board, f"'{board}' is given up", "given_up")

    def _end(self) -> None:
        """Take the end of the run down: why, how far, and the digest; then let the boards go."""
        for heard in self._alarms.drain():
            self._journal.keep(heard.event)
        words = self.segment.words
        stop = words[System.STOP_TICK] or words[System.TICK] + 1
        state, reason = self._ending.final_state()
        # A stop may also be requested from outside, by a word in the segment.
        cause = self._cause or ("stopped" if words[System.STOP_REQUEST] else self._ending.cause())
        if cause in ("task done", "time over"):
            self._faults += self._ending.latched()
        self._let_go()
        self.outcome = Outcome(cause, stop, state, reason, digest(self.segment, stop), tuple(self._faults))
        self._journal.tell("end", "", f"{cause} after {stop} ticks{': ' + reason if reason else ''}")

    def close(self) -> None:
        """Take everything down; afterwards no process and no segment of this rack is left."""
        if self._crate is None:
            return
        crate, self._crate = self._crate, None
        try:
            if hasattr(self, "segment"):
                self._let_go()
            if self._cause == "board lost" or self._has_lost():
                crate.ask(PowerOff())
            # A crate that has no boards yet may still be importing for them.
            crate.close(LEAVE_S if self._pids else 0)
        finally:
            # By its name: what interrupted the launch may have come before the segment was known here.
            remove_own(self.config.name)
            if hasattr(self, "segment"):
                self.segment.close()

    def _has_lost(self) -> bool:
        """Say whether a board is lost that may not end by itself."""
        return hasattr(self, "segment") and any(self.segment.block(t.name)[Block.LOST] for t in self._plan.layout.tasks)

    def _let_go(self) -> None:
        """Tell the boards and the clock that the run is over."""
        self.segment.words[System.STOP_REQUEST] = 1
        self.segment.words[System.STATE] = Run.STOPPED

    def _state(self, task: str) -> int:
        return self.segment.block(task)[Block.STATE]

    @property
    def _line(self) -> CrateLine:
        assert self._crate is not None, "the rack is launched"
        return self._crate


def _wait(fds: list[int], timeout_s: float) -> list[int]:
    poll = select.poll()
    for fd in fds:
        poll.register(fd, select.POLLIN)
    return [fd for fd, _ in poll.poll(max(0, int(timeout_s * 1000)))]


def _status(status: int) -> str:
    return f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
