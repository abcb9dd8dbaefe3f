"""Supervision of the boards of a rack, from their power-on to the end of the run."""

from __future__ import annotations

import os
from contextlib import suppress
from multiprocessing.connection import wait
from time import monotonic

from rack.backplane.address_map import CLOCK
from rack.backplane.checked import select_item
from rack.backplane.errors import DamageError, EmergencyStopError
from rack.backplane.lines import UtilityLines
from rack.backplane.mailbox.history import compute_digest
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Block, Run, System
from rack.boards.config.resolved import Resolved
from rack.boards.crate.alarm_events import AlarmReader, ReadAlarm
from rack.boards.crate.heartbeat import Heartbeat
from rack.boards.crate.lateness import find_late_tasks
from rack.boards.crate.line import CrateLine
from rack.boards.crate.patience import PeerWaitReporter, ReportedWait
from rack.boards.crate.recovery import CLOCKS, UP_STATES, Recovery, RestartPolicy
from rack.boards.crate.requests import Ended, Forked, ForkFailed
from rack.boards.errors import NO_SNAPSHOTS_PREFIX, ConfigError, LaunchError, Mistake
from rack.boards.events import SUCCESSES, Cause, Ending, Journal, Outcome, list_brakings

MOST_TICKS = 1 << 48
"""Number of ticks that no run reaches. A larger number in the segment is damage."""
EARLY_NS = 1_000_000_000
"""Simulated time, in ns, in which copies of a level differ only if it is not deterministic."""
LAST_CYCLES_S = 0.2
"""Time that boards have to finish their last cycles before these are counted."""
STOP_S = 0.8
"""Time that the clock has to end the run after a stop request. Then the Rack ends it."""


class Supervisor:
    """Watches the boards of a rack, restarts lost boards, and ends the run.

    Attributes:
        segment: Segment of the rack.
        plan: The resolved config that was launched.
        policy: Restart policy.
        recovery: Recovery of lost boards.
        alarms: Reader of the boards' alarms.
        pids: Process ids of the boards, keyed by name.
        is_armed: Whether the emergency-stop latch, which is set at the launch, has been reset.
        outcome: Outcome of the run. None while it lasts.
    """

    def __init__(
        self, segment: Segment, plan: Resolved, crate: CrateLine, journal: Journal
    ) -> None:
        self.segment = segment
        self.plan = plan
        self.policy = RestartPolicy(plan.config, plan.layout)
        self.recovery = Recovery(segment, self.policy, crate, journal)
        self.alarms = AlarmReader(segment)
        self.pids: dict[str, int] = {}
        self.is_armed = False
        self.outcome: Outcome | None = None
        self.longest = 0
        """Ticks after which the run fails without an end of its task. 0 for no limit."""
        self._crate = crate
        self._journal = journal
        self._heartbeat = Heartbeat(segment)
        self._awaited = PeerWaitReporter(segment, journal)
        self._why_stopped = ""
        self._stop_by: float | None = None

    def await_ready(self, limit_s: float) -> None:
        """Wait until all boards have passed their self-tests.

        Args:
            limit_s: Time limit in s.

        Raises:
            LaunchError: A board failed, or the time limit is exceeded.
        """
        patience = ReportedWait(self._journal, limit_s)
        tasks = {task.name: self.segment.get_block(task.name) for task in self.plan.layout.tasks}
        while absent := [
            name for name, block in tasks.items() if block[Block.STATE] not in UP_STATES
        ]:
            self._wait_for_messages(patience.left_s)
            if self.recovery.faults:
                raise self._crate.build_error(self.recovery.faults[0])
            if patience.is_over:
                raise LaunchError(f"boards {', '.join(absent)}: not ready within {limit_s:g} s")
            patience.report_if_due(f"boards {', '.join(absent)} are starting")

    def watch(self, timeout_s: float) -> bool:
        """Supervise the boards for up to `timeout_s`. Return False if the run has ended.

        If the rack is held, return after the next message or alarm.
        """
        deadline = monotonic() + timeout_s
        while self.outcome is None:
            self._wait_for_messages(min(deadline, self._stop_by or deadline) - monotonic())
            if self._why_stopped and self._stop_by is None:
                self._stop_by = monotonic() + STOP_S
                self._journal.add_event("stop", "", self._why_stopped)
            self._record_printed()
            for raised in self.alarms.read_alarms():
                self._handle_alarm(raised)
            for board in self._heartbeat.find_hanging():
                self.recovery.report_hanging(board)
                if board == CLOCK:
                    self._kill_clock(self.segment.words[System.CLOCK_PID])
                else:
                    self.recovery.kill_hanging(board)
            self._awaited.report_if_due()
            self.recovery.restart_due_boards()
            if not self.is_armed:
                self.reset_latch()
            is_late = self._stop_by is not None and monotonic() >= self._stop_by
            if self._is_stopped or self.recovery.is_beyond_help or is_late:
                self._end_run()
            if monotonic() >= deadline or self.segment.words[System.HELD]:
                break
        return self.outcome is None

    def _handle_alarm(self, raised: ReadAlarm) -> None:
        """Record an alarm as an event, and kill a process that hangs or has strayed.

        Raises:
            ConfigError: Two copies of a level are compared, which is not deterministic.
        """
        self._journal.record_event(raised.event)
        if raised.alarm in (Alarm.HANG, Alarm.STRAYED):
            task = select_item(self.plan.layout.tasks, raised.subject, "task")
            self.recovery.kill_hanging(task.name)
        elif raised.alarm == Alarm.CLOCK_STOPPED:
            # Kill the clock only if it is still the reported process and not its successor.
            self._kill_clock(raised.subject)
        elif raised.alarm == Alarm.DIFFERS:
            board = self.plan.layout.find_task(raised.event.board).board
            is_disturbed = (
                self.segment.words[System.INJECTED]
                or self.segment.get_block(board)[Block.HAND_OVERS]
            )
            is_early = raised.event.tick * self.plan.layout.clock_ns < EARLY_NS
            if is_early and not is_disturbed:
                why = f"the level is not deterministic: {raised.event.text}, at the start"
                raise ConfigError([Mistake(f"board.{board}.compare", True, why)])

    def _kill_clock(self, pid: int) -> None:
        """Kill a process if it is the clock or its standby."""
        for name in CLOCKS:
            if self.pids.get(name) == pid:
                self.recovery.kill_hanging(name)

    def stop(self, why: str) -> None:
        """End the run at the next tick. Safe to call at any time, even in a signal handler."""
        self._why_stopped = self._why_stopped or why
        self.segment.words[System.STOP_REQUEST] = 1
        os.eventfd_write(self._crate.attention, 1)

    def reset_latch(self) -> None:
        """Reset the emergency-stop latch, unless an input still demands a stop."""
        with suppress(EmergencyStopError):
            UtilityLines(self.segment).reset_emergency_stop()
            self.is_armed = True

    def end_boards(self) -> None:
        """Tell the clock and the boards that the run is over."""
        self.segment.words[System.STOP_REQUEST] = 1
        self.segment.words[System.STATE] = Run.STOPPED

    def _record_printed(self) -> None:
        """Record each line that boards have printed since the last call as an event."""
        for line in self._crate.read_output():
            self._journal.add_event(
                "ready" if line.startswith(NO_SNAPSHOTS_PREFIX) else "printed", "", line
            )

    def _wait_for_messages(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` for an alarm or a message from the crate, and handle messages."""
        attention = self._crate.attention
        for ready in wait([self._crate.line, attention], timeout_s):
            if ready == attention:
                os.eventfd_read(attention)
            else:
                self._handle_message()

    def _handle_message(self) -> None:
        """Receive a message from the crate and act on it."""
        message = self._crate.receive_message()
        if isinstance(message, ForkFailed):
            if self.segment.words[System.STATE] == Run.STARTING:
                raise LaunchError(message.why)
            self._journal.add_event("printed", "", message.why)
            message = message.end
        match message:
            case Forked(name, pid):
                self.pids[name] = pid
            case Ended(name, status) as end:
                self.pids.pop(name, None)
                is_board = name in CLOCKS or name in self.segment.map.blocks
                is_over = self._is_stopped or self.outcome is not None
                if is_board and not (is_over and status == 0):
                    # The restart policy applies to a board that died before the run stopped, even
                    # if its end is reported later.
                    died_before = name not in CLOCKS and self.segment.get_block(name)[Block.LOST]
                    is_late = self._is_stopped and not died_before
                    self.recovery.record_loss(end, is_late, self._record_printed)
            case None:
                self.recovery.record_crate_loss()

    def _end_run(self) -> None:
        """Tell the boards that the run is over, and determine and record its outcome."""
        for raised in self.alarms.read_alarms():
            self._journal.record_event(raised.event)
        words = self.segment.words
        stop = words[System.TICK] + 1
        if planned := words[System.STOP_TICK]:
            # If the clock did not react to a stop request, the run ended before its planned end.
            stop = min(stop, planned)
        if not 0 <= stop < MOST_TICKS:
            raise DamageError(f"a run of {stop} ticks")
        clock = self.plan.build_clock_wiring(None)
        ending = Ending(self.segment, clock.ends_run, clock.silent, self.longest)
        state, reason = ending.find_final_state()
        cause: Cause = ending.find_cause()
        if self.recovery.given_up:
            cause = "board lost"
        elif words[System.STOP_REQUEST]:
            # Another process may also have requested the stop.
            cause = "stopped"
        faults = self.recovery.faults
        events = self._journal.events
        tick_ms = self.plan.config.clock_ns * 1e-6
        braking_periods = list_brakings(events, stop, tick_ms)
        if cause in SUCCESSES:
            faults += ending.list_latched_faults()
        if cause == "time over":
            faults += ending.find_long_holds(events, braking_periods, stop * tick_ms)
        objects = ending.find_object_ends(self.plan.goals)
        if cause == "task done":
            # With this form of the comparison, NaN counts as too far.
            faults += [str(end) for end in objects if not end.off_mm <= end.tolerance_mm]
        self.end_boards()
        # Let boards finish the cycles that they have begun.
        patience = ReportedWait(self._journal, LAST_CYCLES_S)
        while any(map(self._is_cycling, self.pids)) and not patience.is_over:
            self._wait_for_messages(patience.left_s)
        late, excused = find_late_tasks(self.segment, self.plan.config, stop)
        self.outcome = Outcome(
            cause=cause,
            ticks=stop,
            state=state,
            reason=reason,
            digest=compute_digest(self.segment, stop),
            faults=(*faults, *late),
            brakings=braking_periods,
            objects=objects,
            excused=tuple(excused),
        )
        self._journal.add_event(
            "end", "", f"{cause} after {stop} ticks{': ' + reason if reason else ''}"
        )

    def _is_cycling(self, name: str) -> bool:
        """Return True if a board has not finished its last released cycle and is not lost."""
        if self.recovery.is_beyond_help or name not in self.segment.map.blocks:
            return False
        block = self.segment.get_block(name)
        return block[Block.DONE] < block[Block.RELEASED] and not block[Block.LOST]

    @property
    def _is_stopped(self) -> bool:
        """Whether the run has stopped."""
        return self.segment.words[System.STATE] == Run.STOPPED
