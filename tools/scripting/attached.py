"""A running rack for a Python program, which can read, command, disturb and record it.

Each method does the same as the command of its name, and uses the same library.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Self

import numpy as np

from rack.backplane.lines import UtilityLines
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import AnyMessage
from rack.backplane.segment import Segment
from rack.boards.crate.alarm_events import AlarmReader
from rack.boards.events import Event
from rack.tools.console.answer import Document, Failure, convert_errors
from rack.tools.faults.live import LiveRack
from rack.tools.launch.folder import choose_run_folder
from rack.tools.monitor import pausing
from rack.tools.monitor.desk import LevelCommander
from rack.tools.monitor.replies import Reply
from rack.tools.monitor.snapshot import RackMonitor, Snapshot
from rack.tools.recording.recorder.process import start_recorder
from rack.tools.recording.signal import Signal, Trigger, find_mailbox

READ_INTERVAL_S = 0.001
"""Time between two readings of the rack."""


def attach(rack: str) -> AttachedRack:
    """Attach to the running rack of that name on this machine. Raises `Failure`."""
    return AttachedRack(rack)


class AttachedRack:
    """A running rack. Use it as a context, or call `close` at the end.

    Every error is raised as a `Failure`, with the text that the command would print.
    """

    @convert_errors()
    def __init__(self, rack: str) -> None:
        segment = self._segment = Segment.attach(rack)
        self._closing = ExitStack()
        self._closing.enter_context(closing(segment))
        self._boxes = segment.layout.mailboxes
        self._desk = LevelCommander(segment)
        self._monitor = RackMonitor(segment)
        self._alarms = AlarmReader(segment)
        self._alarms.read_alarms()
        # Events since the rack was attached, without those that `wait_for` has returned.
        self._events: list[Event] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        state = "over" if self._segment.run_is_over else "not over"
        return f"<attached to rack '{self._segment.rack}': {state}>"

    def close(self) -> None:
        """Detach from the rack, which continues to run, and finish its recording."""
        self._closing.close()

    @convert_errors()
    def status(self) -> Snapshot:
        """Take a snapshot of the rack."""
        return self._monitor.take_snapshot()

    @convert_errors()
    def read(self, mailbox: str) -> Reading[AnyMessage]:
        """Read a copy of the newest message of a mailbox. This does not delay any board."""
        return open_observer(self._segment, find_mailbox(mailbox, self._boxes).name).peek()

    @convert_errors()
    def __getitem__(self, name: str) -> Any:
        """Return the newest value of a signal, as in `servo.status.position`.

        The value is an array or a number, or the name of a state.
        """
        signal = Signal.parse(name, self._boxes)
        reading = self.read(signal.mailbox)
        if not reading.has_message:
            raise Failure(f"mailbox '{signal.mailbox}' has no message yet")
        return signal.read_message(reading.message.record)

    @convert_errors()
    def command(self, level: str, what: str, wait_s: float | None = None, **goal: Any) -> Reply:
        """Command a level, as in `command("servo", "setpoint", joints=(...), wait_s=10)`.

        Args:
            level: Name of the level.
            what: The verb of the command.
            wait_s: Maximum wall-clock time to wait until the command is done. None to wait only
                until the level has accepted it.
            goal: Further keys of a `[[command]]` table.

        Returns:
            The reply of the level.
        """
        goal_values = {
            key: v.tolist() if isinstance(v, np.ndarray) else v for key, v in goal.items()
        }
        request = {"level": level, "what": what, **goal_values}
        return _check_reply(self._desk.give_command(request, wait_s is not None, wait_s))

    @convert_errors()
    def set(self, key: str, value: object) -> Reply:
        """Set a live parameter, as in `set("board.servo.params.bandwidth", 80)`."""
        return _check_reply(self._desk.set_param(f"{key}={value}"))

    @convert_errors()
    def inject(self, board: str, kind: str, wait_s: float | None = None, **fields: Any) -> Document:
        """Inject a fault, as in `inject("servo", "sensor-bias", joint=2, size=0.05, lasts=0.2)`.

        Args:
            board: Task to be disturbed, or "clock".
            kind: Kind of fault.
            wait_s: Maximum wall-clock time to wait until the fault is over. None to wait only until
                it has begun.
            fields: Further keys of a `[[fault]]` table, with `lasts` in place of `for`.

        Returns:
            The fault, as `rack inject --json` prints it.
        """
        if "lasts" in fields:
            fields["for"] = fields.pop("lasts")
        fault = {"board": board, "kind": kind, **fields}
        return LiveRack(self._segment).inject_fault(fault, wait_s is not None, wait_s)

    @convert_errors()
    def pause(self) -> pausing.Pause:
        """Pause the rack: in lockstep between two ticks, in real time with the arm at rest."""
        return pausing.pause_rack(self._segment)

    @convert_errors()
    def resume(self) -> None:
        """Let the paused rack continue."""
        pausing.resume_rack(self._segment)

    @convert_errors()
    def estop(self, reset: bool = False) -> None:
        """Engage the brakes from the next tick on, or with `reset` allow the arm to move again."""
        lines = UtilityLines(self._segment)
        lines.reset_emergency_stop() if reset else lines.latch_emergency_stop()

    @convert_errors()
    def wait_until(self, condition: str, timeout_s: float) -> int:
        """Wait until a condition holds, as in `servo.status.position[2] > 1.2`.

        Args:
            condition: A comparison of a signal with a number or a state.
            timeout_s: Maximum wall-clock time to wait.

        Returns:
            Tick of the first message for which the condition holds. The search begins with the
            newest message.
        """
        trigger = Trigger.parse(condition, self._boxes)
        ring = MailboxRing(self._segment, trigger.signal.mailbox)
        newest = slice(-1, None)
        for _ in self._poll_rack(timeout_s):
            rows = ring.read_new_rows().rows[newest]
            holding_ticks = rows["tick"][trigger.evaluate_messages(rows["message"])]
            if len(holding_ticks):
                return int(holding_ticks[0])
            newest = slice(None)
        raise self._build_timeout(condition, timeout_s)

    @convert_errors()
    def wait_for(self, event: str, timeout_s: float) -> Event:
        """Wait for an event, and return it. Events since `attach` are included.

        Each event is returned once. If a rack misses many cycles, events that are not read within
        seconds are overwritten. `Rack.events` contains all of them.

        Args:
            event: Kind or code, as in `detection` or `rejoined`.
            timeout_s: Maximum wall-clock time to wait.
        """
        for _ in self._poll_rack(timeout_s):
            self._events += [alarm.event for alarm in self._alarms.read_alarms()]
            for seen_event in self._events:
                if event in (seen_event.kind, seen_event.code):
                    self._events.remove(seen_event)
                    return seen_event
        lost = f" ({self._alarms.lost} events were overwritten)" if self._alarms.lost else ""
        raise self._build_timeout(f"{event}{lost}", timeout_s)

    def _poll_rack(self, timeout_s: float) -> Iterator[None]:
        """Yield before each reading of the rack, until the time-out or the end of the run."""
        deadline = time.monotonic() + timeout_s
        is_last = False
        while not is_last:
            # Read this before the caller reads the rack, so that its last reading is complete.
            is_last = self._segment.run_is_over or time.monotonic() > deadline
            yield
            time.sleep(READ_INTERVAL_S)

    def _build_timeout(self, awaited: str, timeout_s: float) -> Failure:
        """Return the `Failure` for a wait that ended without the awaited event."""
        why = "the run is over" if self._segment.run_is_over else f"not within {timeout_s:g} s"
        return Failure(f"rack '{self._segment.rack}', {awaited}: {why}")

    @convert_errors()
    def record(self, folder: str | Path | None = None) -> Path:
        """Record the rack until `close`, beginning with the last two seconds in its rings.

        Args:
            folder: Folder of the recording. None for runs/<rack>-<time>.

        Returns:
            The folder.
        """
        wanted = None if folder is None else Path(folder)
        path = choose_run_folder(wanted, self._segment.rack)
        recorder = start_recorder(self._segment, path, words=self._segment.words)
        self._closing.callback(recorder.finish)
        return path


def _check_reply(reply: Reply) -> Reply:
    """Return a reply unchanged. Raises `Failure` if the level refused the command."""
    if not reply.worked:
        raise Failure(reply.line)
    return reply
