"""Alarms as events: what a task or the clock has rung, in words, with names and units, for people and for programs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.alarms import MISSES, Alarm
from rack.backplane.fault_table import Entry, FaultEntry, FaultTable
from rack.backplane.layout import Layout
from rack.backplane.words import Demand
from rack.boards.events import Event, EventKind
from rack.boards.faults.describe import board_of, describe_kind, joint_name, subject_of

About = Literal["task", "mailbox", "joint", "geom", "nothing"]
EMERGENCY_STOP = "emergency stop"

KIND_OF: Mapping[Alarm, EventKind] = {
    Alarm.FAULT_BEGINS: "fault",
    Alarm.FAULT_ENDS: "fault",
    Alarm.REJOINED: "recovery",
    Alarm.DEMAND: "reaction",
    Alarm.BRAKES_CLOSED: "reaction",
    Alarm.BRAKES_OPENED: "recovery",
    Alarm.RE_REFERENCED: "recovery",
    Alarm.LATCHED: "reaction",
    **dict.fromkeys(MISSES, "miss"),
}
"""What an alarm is; any other is a detection."""
TEXTS: Mapping[Alarm, tuple[About, str]] = {
    Alarm.HANG: ("task", "'{subject}' hangs: {value:.0f} releases unanswered since tick {since}"),
    Alarm.REJOINED: ("task", "back on the grid after {span}"),
    Alarm.LATE: ("task", "'{subject}' has not finished before its next release"),
    Alarm.PLAN_LATE: ("task", "'{subject}' has not finished its plan in its cycles"),
    Alarm.STARVED: ("task", "'{subject}' does not get its core: {value:.0f} releases unanswered since tick {since}"),
    Alarm.STALE: ("mailbox", "'{subject}' is {span} old: its writer '{writer}' is dead or stopped"),
    Alarm.MUTE: ("mailbox", "'{subject}' is {span} old: its writer '{writer}' cycles and writes nothing"),
    Alarm.GAP: ("mailbox", "'{subject}' lacks {value:.0f} message(s): their serials are missing"),
    Alarm.HELD_BACK: ("mailbox", "'{subject}': a message came {span} later than it was to be seen"),
    Alarm.DISORDER: ("mailbox", "'{subject}': a later serial is {span} older than the one before"),
    Alarm.DAMAGED: ("mailbox", "'{subject}': a message failed its CRC"),
    Alarm.BABBLE: ("mailbox", "'{subject}': {value:g} messages a cycle; its writer '{writer}' may write one"),
    Alarm.MASQUERADE: ("mailbox", "'{subject}': a message names process {value:.0f}, which does not hold the claim"),
    Alarm.LOCKED: ("mailbox", "'{subject}': its lock was not given back within the bound of a wait"),
    Alarm.CLOCK_STOPPED: ("nothing", "the clock has given out no tick for {span}"),
    Alarm.CLOCK_SKIPPED: ("nothing", "the clock has left out {value:.0f} tick(s)"),
    Alarm.CLOCK_LATE: ("nothing", "a tick came {late_ms:.3f} ms late"),
    Alarm.SENSOR_RANGE: ("joint", "sensor of {subject}: {value:g} rad is no position it can have"),
    Alarm.SENSOR_STUCK: ("joint", "sensor of {subject}: no change in {value:.0f} cycles while the arm is driven"),
    Alarm.SENSOR_SILENT: ("nothing", "the sensors have given no new sample for {span}"),
    Alarm.SENSOR_MODEL: ("joint", "sensor of {subject}: off the model's motion by {value:.3g}"),
    Alarm.ACTUATOR: ("joint", "{subject} does not do what its torque should: off by {value:.3g}"),
    Alarm.COMMAND_INVALID: ("joint", "rejected: torque of {subject} is not a number"),
    Alarm.COMMAND_LIMIT: ("joint", "torque of {subject}, {value:.3g} N m, is beyond its limit: cut"),
    Alarm.BRAKES_OPENED: ("nothing", "brakes released after {span}"),
    Alarm.RE_REFERENCED: ("joint", "sensor of {subject} trusted again, {value:.3g} rad from where it was estimated"),
    Alarm.COLLISION: ("geom", "unintended contact: '{subject}' touches '{writer}'"),
    Alarm.LATCHED: ("joint", "fault of {subject} latched at {value:.4g}: brakes stay engaged"),
}


def event_of(
    row: np.void,
    owner: str,
    layout: Layout,
    faults: FaultTable,
    joints: Sequence[str],
    geom: Callable[[int], str] = str,
) -> Event:
    """Return the event that an alarm makes: a row of `rack.backplane.alarms.RECORD` from the ring of the task `owner`.

    `geom` names a geom of the cell. An event's board is who found it; of a fault it is who has it, of a return it is
    who is back. An operator's command is an event of `AlarmWatch`.
    """
    alarm, number, value = Alarm(row["code"]), int(row["subject"]), float(row["value"])
    kind, code, board, fault = KIND_OF.get(alarm, "detection"), alarm.name.lower(), owner, -1
    if kind == "fault":
        entry = faults.entries[number]
        subject, board, fault = subject_of(entry, layout, joints), board_of(entry, layout), number
        code = "begins" if alarm == Alarm.FAULT_BEGINS else "ends"
        text = f"{describe_kind(entry, layout, joints)} {code}{_course(entry, code, layout)}"
    elif alarm == Alarm.DEMAND:
        subject, demand = _task(number, layout, EMERGENCY_STOP), Demand(int(value))
        kind, text = ("reaction" if demand else "recovery"), _demand(demand, subject)
    elif alarm == Alarm.BRAKES_CLOSED:
        subject, text = "", _closed(value, layout)
    else:
        subject, text = _told(alarm, row, layout, joints, geom)
        board = subject if alarm == Alarm.REJOINED else owner
    realtime_ns = int(row["time_ns"]) + time.time_ns() - time.monotonic_ns()
    return Event(realtime_ns, int(row["tick"]), kind, board, text, code, fault, subject, value, int(row["since"]))


def _told(
    alarm: Alarm, row: np.void, layout: Layout, joints: Sequence[str], geom: Callable[[int], str]
) -> tuple[str, str]:
    about, text = TEXTS[alarm]
    number, value = int(row["subject"]), float(row["value"])
    subject = writer = ""
    if about == "task":
        subject = _task(number, layout, CLOCK)
    elif about == "joint":
        subject = joint_name(number, joints)
    elif about == "geom":
        subject, writer = geom(number), geom(int(value))
    elif about == "mailbox":
        subject, writer = layout.mailboxes[number].name, layout.mailboxes[number].writer
    span, since = _span(value, layout), int(row["since"])
    return subject, text.format(
        subject=subject, writer=writer, value=value, span=span, since=since, late_ms=value * 1e-6
    )


def _course(entry: FaultEntry, code: str, layout: Layout) -> str:
    """Return how long a fault that begins will last, or how often one that ends has acted."""
    if code == "ends":
        return f"; it acted {entry[Entry.COUNT]} time(s)"
    return f", for {_span(entry[Entry.TICKS], layout)}" if entry[Entry.TICKS] else ""


def _task(number: int, layout: Layout, other: str) -> str:
    return layout.tasks[number].name if number >= 0 else other


def _span(ticks: float, layout: Layout) -> str:
    return f"{ticks:.0f} ticks ({ticks * layout.clock_ns * 1e-6:g} ms)"


def _demand(demand: Demand, subject: str) -> str:
    why = "the latch is set" if subject == EMERGENCY_STOP else f"'{subject}' is lost"
    if demand == Demand.NONE:
        return "nothing is demanded of the arm any more"
    return f"the arm must {'ramp to rest, then brake' if demand == Demand.STOP else 'brake at once'}: {why}"


def _closed(ticks: float, layout: Layout) -> str:
    return f"brakes engaged: {_span(ticks, layout)} without torque" if ticks else "brakes engaged"
