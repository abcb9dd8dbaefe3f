"""Alarm rings, in which a task or the clock reports the faults that it has detected.

An alarm is one record of fixed size, and raising it never waits. An alarm is raised once per
episode, at the beginning of a condition, not in every cycle while the condition lasts.
"""

from __future__ import annotations

from enum import IntEnum
from os import eventfd_write
from time import monotonic_ns

import numpy as np

from rack.backplane.address_map import ALARM_DEPTH, ALARM_RECORD_SIZE, CACHE_LINE
from rack.backplane.ring import Ring
from rack.backplane.segment import Segment

RECORD = np.dtype(
    [
        ("tick", "i8"),  # release, in ticks, of the cycle that found it; for the clock, its tick
        ("time_ns", "i8"),  # CLOCK_MONOTONIC
        ("code", "i8"),  # Alarm
        ("subject", "i8"),  # see Alarm, -1 for none
        ("value", "f8"),  # the measured value, see Alarm
        ("since", "i8"),  # tick since which the condition holds; `tick` if not known
        ("text", "S144"),  # UTF-8: a level's description of its finding
    ]
)


PEER = -2
"""Subject of `Alarm.DEMAND` if the loss of another rack requires the stop."""


BRAKED_BY_DEMAND = -1
BRAKED_WITHOUT_TORQUE = -2
BRAKED_AT_START = -3
"""Reasons for engaged brakes other than an error of the level.

The brakes engaged because the safety functions required it (`BRAKED_BY_DEMAND`), because no torque
was received in time (`BRAKED_WITHOUT_TORQUE`), or because no torque had been received since the
start (`BRAKED_AT_START`).
"""


class Alarm(IntEnum):
    """Kinds of alarms. Comments state the meaning of [subject; value]."""

    # Raised by the clock: faults, losses and demands.
    FAULT_BEGINS = 1  # [entry of the fault table; -]
    FAULT_ENDS = 2  # [entry; times it acted]
    HANG = 3  # [task; releases missed]
    REJOINED = 4  # [task, -1: the clock itself; ticks it was away]
    # [task whose loss demands it, PEER: another rack's, -1: the emergency stop or nobody; Demand]
    DEMAND = 5
    COMMANDED = 6  # [entry of the operator table; serial]  an operator's command was issued
    # [mailbox; ticks since the fault ended] a good message made after a fault of its messages
    FLOWS = 7
    # [mailbox; -, the text names the field] a standby computes another message than the active copy
    DIFFERS = 9
    STRAYED = 15  # [task; -]  this copy of a task differs from two others, and is taken out
    # [task, -1: the clock, -2: its standby; HandOver] this copy is active from this tick
    TAKEN_OVER = 14
    NOT_SWITCHED = 16  # [task; -]  an operator's switch: no standby has the state of this copy
    OPERATOR_GONE = 8  # [entry of the operator table; serial]  a command under a lease: hold
    # Raised by the clock: tasks that miss their cycles.
    LATE = 10  # [task; releases missed]  an executor has not finished before its next release
    PLAN_LATE = 11  # [task; releases missed]  a plan has not finished within its cycles (eq. 3.8)
    STARVED = 12  # [task; releases missed]  a task that could run does not get its core
    # [task; Scheduler]  the system refuses another scheduler of a task, see the text
    SCHEDULER_KEPT = 13
    # Raised by readers: mailboxes.
    STALE = 20  # [mailbox; age, ticks]  its writer is dead or stopped
    MUTE = 21  # [mailbox; age, ticks]  its writer is running but not writing
    GAP = 22  # [mailbox; serials missing]
    HELD_BACK = 23  # [mailbox; ticks]  a message came after the end of its cycle
    DISORDER = 24  # [mailbox; ticks]  a later serial has an earlier tick
    DAMAGED = 25  # [mailbox; -]  a message failed its check
    BABBLE = 26  # [mailbox; serials per cycle]
    # [mailbox; process id that the message names]  not from the writer that holds the claim
    MASQUERADE = 27
    LOCKED = 28  # [mailbox; -]  a dead or stopped process holds the lock
    # Raised by writers: mailboxes.
    # [mailbox; messages refused in the cycle] its reader does not take messages as fast as they
    # come
    QUEUE_FULL = 29
    # Raised by tasks: the clock.
    CLOCK_STOPPED = 30  # [process id of that clock; ticks]
    CLOCK_SKIPPED = 31  # [-1; ticks skipped]
    # [-1; lateness, ns] raised by the clock too. It woke this much after the grid point of tick
    # `since`.
    CLOCK_LATE = 32
    # Raised by boards: what interrupts them.
    # [mailbox; messages lost in the cycle]  too many waited for the interrupt handler
    INBOX_FULL = 33
    # Raised by the servo level: the arm.
    SENSOR_RANGE = 40  # [joint; value]  NaN, or beyond the joint's range
    SENSOR_STUCK = 41  # [joint; cycles]  no change while the arm is driven
    SENSOR_SILENT = 42  # [-1; age, ticks]  no new sample
    SENSOR_MODEL = 43  # [joint; residual]  the sensed position disagrees with the model's motion
    ACTUATOR = 44  # [joint; residual]  the arm does not follow its torques
    COMMAND_INVALID = 45  # [joint; -]  rejected: a torque is NaN or infinite
    COMMAND_LIMIT = 46  # [joint; N m]  a torque beyond its limit was cut
    # [error of the level, 0: the boards above, or `BRAKED_BY_DEMAND` ...; ticks without]
    BRAKES_CLOSED = 47
    BRAKES_OPENED = 48  # [as they engaged; ticks they were engaged]
    RE_REFERENCED = 49  # [joint; distance from its estimate, rad]  its sensor is trusted again
    COLLISION = 50  # [geom; the other geom]  unintended contact of the arm or of what it holds
    # [joint, -1: several; value]  a fault has lasted too long: the brakes stay engaged
    LATCHED = 51
    # [number among the level's `names`; -]  a control modification failed and was taken out
    MODIFICATION = 52
    # [-1; N] a contact's force beyond the arm's limit, or the end of the wrist sensor's range
    FORCE_LIMIT = 53
    MOMENT_LIMIT = 54  # [-1; N m]  a contact's torque, likewise
    LIMIT_EXCEEDED = 58  # [joint; rad or rad/s]  the arm is beyond a limit, by its samples
    SENSOR_LATE = 59  # [-1; age, ticks]  samples older than the config permits
    # [joint; rad from where it is, NaN: not finite]  rejected: a set point that no drive may have
    SET_POINT = 66
    # Raised by the board of a hand.
    TENSION_INVALID = 55  # [joint; -]  rejected: a tension is NaN or infinite
    TENSION_LIMIT = 56  # [joint; N]  a tension beyond its limits was cut
    TENDON = 57  # [joint; N]  a tendon stays slack, although a tension is wanted of it
    # Raised by the network adapter: other racks, and those who ask from other machines.
    PEER_LOST = 60  # [number among the level's `names`; -]
    PEER_BACK = 61  # [number; ticks it was away]  the same launch as before
    PEER_RESTARTED = 62  # [number; ticks it was away]  another launch
    REMOTE_STOP = 63  # [number; -]  another machine has set the emergency stop
    # Raised by a level of a user's own: what it has declared.
    OWN = 70  # [number among the level's `finding_kinds`; as declared]


MISSES = (Alarm.LATE, Alarm.PLAN_LATE, Alarm.STARVED, Alarm.CLOCK_SKIPPED, Alarm.CLOCK_LATE)
"""Alarms about missed cycles, which are counted but do not wake the Rack.

All other alarms report faults or reactions to them.
"""


class AlarmWriter:
    """Writing end of the alarm ring of a task or of the clock.

    Args:
        segment: Memory of the rack.
        task: Name of the task, "clock" for the clock.
        attention: eventfd that wakes the Rack. None to wake no process.
    """

    def __init__(self, segment: Segment, task: str, attention: int | None = None) -> None:
        address = segment.map.alarms[task]
        self._head = segment.words[address // 8 : address // 8 + 1]
        memory = segment.get_bytes(address + CACHE_LINE, ALARM_DEPTH * ALARM_RECORD_SIZE)
        self._slots = np.frombuffer(memory, dtype=RECORD)
        self._attention = attention

    def raise_alarm(
        self,
        tick: int,
        code: Alarm,
        subject: int = -1,
        value: float = 0.0,
        since: int | None = None,
        text: str = "",
    ) -> None:
        """Append an alarm, and wake the Rack unless the alarm is one of `MISSES`.

        Args:
            tick: Release tick of the cycle that found the condition.
            code: Kind of alarm.
            subject: Subject as described at `Alarm`, -1 for none.
            value: Measured value as described at `Alarm`.
            since: Tick since which the condition holds. None if it is not known.
            text: A level's description of its finding.
        """
        count = self._head[0] + 1
        self._slots[count % ALARM_DEPTH] = (
            tick,
            monotonic_ns(),
            code,
            subject,
            value,
            tick if since is None else since,
            text.encode("utf-8", "replace"),
        )
        self._head[0] = count
        if code not in MISSES:
            self.wake_rack()

    def wake_rack(self) -> None:
        """Wake the Rack, if this writer has its eventfd."""
        if self._attention is not None:
            # This never waits: an eventfd can count more alarms than any run raises.
            eventfd_write(self._attention, 1)


def open_alarm_ring(segment: Segment, task: str) -> Ring:
    """Open the reading end of an alarm ring. Its rows have dtype `RECORD`."""
    address = segment.map.alarms[task]
    head = segment.words[address // 8 : address // 8 + 1]
    memory = segment.get_bytes(address + CACHE_LINE, ALARM_DEPTH * ALARM_RECORD_SIZE)
    return Ring(memory, RECORD, head)


CLEAN_READS = 20
"""Number of accesses, and of cycles of the writer, without a finding after which an episode ends.

It ends when both numbers are exceeded.
"""


class Episodes:
    """Raises alarms about one mailbox: one per episode, however long a fault lasts.

    Each kind of finding, such as a damaged message, has separate episodes. An episode begins with a
    finding and ends once no other has followed for `CLEAN_READS` accesses and as many cycles of the
    writer.
    """

    def __init__(self, segment: Segment, name: str, alarms: AlarmWriter) -> None:
        self._subject = segment.layout.find_mailbox_index(name)
        self._clean_ticks = CLEAN_READS * segment.layout.find_mailbox(name).every
        self._alarms = alarms
        self._last: dict[Alarm, tuple[int, int]] = {}

    def record_finding(
        self, code: Alarm, access: int, tick: int, value: float = 0.0, since: int | None = None
    ) -> None:
        """Record a finding, and raise its alarm if it begins an episode.

        Args:
            code: Kind of alarm.
            access: Number of the access, counted by the caller.
            tick: Release tick of the cycle.
            value: Measured value as described at `Alarm`.
            since: Tick since which the condition holds. None if it is not known.
        """
        if not self.is_open(code, access, tick):
            self.raise_alarm(code, tick, value, since)
        self._last[code] = access, tick

    def raise_alarm(
        self, code: Alarm, tick: int, value: float = 0.0, since: int | None = None
    ) -> None:
        """Raise an alarm unconditionally. Call this only when a new episode is known to begin.

        Args:
            code: Kind of alarm.
            tick: Release tick of the cycle.
            value: Measured value as described at `Alarm`.
            since: Tick since which the condition holds. None if it is not known.
        """
        self._alarms.raise_alarm(tick, code, self._subject, value, since)

    def is_open(self, code: Alarm, access: int, tick: int) -> bool:
        """Check whether an episode of this kind has begun and not yet ended.

        Args:
            code: Kind of alarm.
            access: Number of the current access, counted by the caller.
            tick: Release tick of the cycle.
        """
        if code not in self._last:
            return False
        last_access, last_tick = self._last[code]
        return access - last_access <= CLEAN_READS or tick - last_tick <= self._clean_ticks
