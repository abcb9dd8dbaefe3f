"""Alarm rings: what a task, or the clock, has to tell besides its cycles. One fixed record an alarm, never a wait.

An alarm is rung once an episode: when a condition is found, not in every cycle that it lasts.
"""

from __future__ import annotations

from enum import IntEnum
from os import eventfd_write
from time import monotonic_ns

import numpy as np

from rack.backplane.address_map import ALARM_DEPTH, ALARM_RECORD_SIZE, LINE
from rack.backplane.ring import Ring
from rack.backplane.segment import Segment

RECORD = np.dtype(
    [
        ("tick", "i8"),  # release, in ticks, of the cycle that found it; the clock's: its tick
        ("time_ns", "i8"),  # CLOCK_MONOTONIC
        ("code", "i8"),  # Alarm
        ("subject", "i8"),  # what it is about, see Alarm; -1: nothing in particular
        ("value", "f8"),  # the measured value, see Alarm
        ("since", "i8"),  # tick since which the condition holds, as far as it is known; else `tick`
        ("spare0", "i8"),
        ("spare1", "i8"),
    ]
)


class Alarm(IntEnum):
    """What an alarm says. In brackets: subject; value."""

    # The clock tells of faults, losses and demands.
    FAULT_BEGINS = 1  # [entry of the fault table; -]
    FAULT_ENDS = 2  # [entry; times that it acted]
    HANG = 3  # [task; releases unanswered]
    REJOINED = 4  # [task, -1: the clock itself; ticks it was away]
    DEMAND = 5  # [task whose loss demands it, -1: the emergency stop or nobody; Demand]
    COMMANDED = 6  # [entry of the operator table; serial]  an operator's command was given
    # The clock tells of tasks that do not keep their cycles.
    LATE = 10  # [task; releases unanswered]  an executor has not ended before its next release
    PLAN_LATE = 11  # [task; releases unanswered]  a plan has not ended with its cycles (eq. 3.8)
    STARVED = 12  # [task; releases unanswered]  a task that could run does not get its core
    # Readers tell of mailboxes.
    STALE = 20  # [mailbox; age, ticks]  its writer is dead or stopped
    MUTE = 21  # [mailbox; age, ticks]  its writer cycles, and writes nothing
    GAP = 22  # [mailbox; serials missing]
    HELD_BACK = 23  # [mailbox; ticks]  a message came later than its stamp permits
    DISORDER = 24  # [mailbox; ticks]  a later serial has an earlier tick
    DAMAGED = 25  # [mailbox; -]  a message failed its CRC
    BABBLE = 26  # [mailbox; serials a cycle]
    MASQUERADE = 27  # [mailbox; process id that the message names]  not from the writer that holds the claim
    LOCKED = 28  # [mailbox; -]  the bound of a wait for a lock cut an access off
    # Tasks tell of the clock.
    CLOCK_STOPPED = 30  # [process id of the clock that is meant; ticks]
    CLOCK_SKIPPED = 31  # [-1; ticks left out]
    CLOCK_LATE = 32  # [-1; lateness, ns]
    # The servo level tells of the arm.
    SENSOR_RANGE = 40  # [joint; value]  no number, or beyond what the joint can be at
    SENSOR_STUCK = 41  # [joint; cycles]  no change while the arm is driven
    SENSOR_SILENT = 42  # [-1; age, ticks]  no new sample
    SENSOR_MODEL = 43  # [joint; residual]  what is sensed is not what the model's motion leads to
    ACTUATOR = 44  # [joint; residual]  the arm does not do what its torques should
    COMMAND_INVALID = 45  # [joint; -]  rejected: a torque is not a number
    COMMAND_LIMIT = 46  # [joint; N m]  a torque beyond the limits was cut
    BRAKES_CLOSED = 47  # [-1; ticks without torque, 0: demanded]
    BRAKES_OPENED = 48  # [-1; ticks they were closed]
    RE_REFERENCED = 49  # [joint; rad]  sensors are trusted again; how far the joint is from where it was thought to be
    COLLISION = 50  # [geom; the other geom]  the arm, or what it holds, touches what no task means
    LATCHED = 51  # [joint, -1: no single one; value]  a fault has lasted too long: the brakes stay engaged


MISSES = (Alarm.LATE, Alarm.PLAN_LATE, Alarm.STARVED, Alarm.CLOCK_SKIPPED, Alarm.CLOCK_LATE)
"""Alarms of cycles that were missed: seen and counted, and nobody need act. All others name a fault, or an act."""


class AlarmWriter:
    """The writing end of an alarm ring: a task's, or the clock's ("clock").

    `attention` is an eventfd that wakes whoever watches the rack; None: nobody is woken.
    """

    def __init__(self, segment: Segment, task: str, attention: int | None = None) -> None:
        address = segment.map.alarms[task]
        self._head = segment.words[address // 8 : address // 8 + 1]
        first = address + LINE
        self._slots = np.frombuffer(segment.view(first, ALARM_DEPTH * ALARM_RECORD_SIZE), dtype=RECORD)
        self._attention = attention

    def ring(self, tick: int, code: Alarm, subject: int = -1, value: float = 0.0, since: int | None = None) -> None:
        """Append an alarm, and wake whoever watches."""
        count = self._head[0] + 1
        found = tick if since is None else since
        self._slots[count % ALARM_DEPTH] = (tick, monotonic_ns(), code, subject, value, found, 0, 0)
        self._head[0] = count
        if self._attention is not None and code not in MISSES:
            # Never a wait: the counter of an eventfd takes more than any run can ring.
            eventfd_write(self._attention, 1)


def alarm_ring(segment: Segment, task: str) -> Ring:
    """Return the reading end of an alarm ring; its rows are of dtype `RECORD`."""
    address = segment.map.alarms[task]
    head = segment.words[address // 8 : address // 8 + 1]
    return Ring(segment.view(address + LINE, ALARM_DEPTH * ALARM_RECORD_SIZE), RECORD, head)
