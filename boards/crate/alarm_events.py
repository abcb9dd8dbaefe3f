"""Conversion of alarms to events, with names and units as text and with codes for programs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from rack.backplane.address_map import CLOCK, CLOCK_STANDBY
from rack.backplane.checked import select_item, to_enum, to_integer
from rack.backplane.fault_table import FaultTable
from rack.backplane.message import escape_text
from rack.backplane.operator_table import OperatorTable
from rack.backplane.segment import Segment
from rack.backplane.standby import HAND_OVER_REASONS
from rack.backplane.watch.alarms import MISSES, PEER, Alarm, open_alarm_ring
from rack.backplane.words import Demand, HandOver, Scheduler
from rack.boards.config.cell import find_geom_name
from rack.boards.config.loader import read_stored
from rack.boards.config.published import PublishedRack
from rack.boards.events import DEMANDED, NO_TORQUE, Event, EventKind
from rack.boards.faults.bounds import format_count
from rack.boards.faults.describe import describe_fault, find_board, find_subject, format_joint
from rack.boards.operator import copy_request_message, describe_command, find_level
from rack.levels.messages import Error
from rack.levels.operator import Operation

ENGAGED_BY = ("the boards above", DEMANDED, NO_TORQUE, "")
"""Reasons why brakes engaged other than errors. Subject -n of an alarm refers to entry n."""
EMERGENCY_STOP = "emergency stop"
ANOTHER_RACK = "another rack"
DEMANDS: Mapping[Demand, str] = {
    Demand.NONE: "arm released: no stop is requested",
    Demand.STOP: "the arm must ramp to rest, then brake: {why}",
    Demand.BRAKE: "the arm must brake at once: {why}",
}
DEMANDED_BY: Mapping[str, str] = {
    EMERGENCY_STOP: "the emergency stop is latched",
    ANOTHER_RACK: "a rack that it works with is lost",
}
"""Reasons why the arm must stop or brake, other than the loss of a board."""

EVENT_KINDS: Mapping[Alarm, EventKind] = {
    Alarm.FAULT_BEGINS: "fault",
    Alarm.FAULT_ENDS: "fault",
    Alarm.REJOINED: "recovery",
    Alarm.TAKEN_OVER: "recovery",
    Alarm.FLOWS: "recovery",
    Alarm.DEMAND: "reaction",
    Alarm.BRAKES_CLOSED: "reaction",
    Alarm.BRAKES_OPENED: "recovery",
    Alarm.RE_REFERENCED: "recovery",
    Alarm.PEER_BACK: "recovery",
    Alarm.PEER_RESTARTED: "recovery",
    Alarm.LATCHED: "reaction",
    Alarm.QUEUE_FULL: "held",
    Alarm.INBOX_FULL: "held",
    Alarm.COMMANDED: "command",
    Alarm.OPERATOR_GONE: "command",
    Alarm.NOT_SWITCHED: "command",
    Alarm.SCHEDULER_KEPT: "command",
    Alarm.REMOTE_STOP: "command",
    **dict.fromkeys(MISSES, "miss"),
}
"""Kind of event for each alarm. All other alarms are detections."""
TEXTS: Mapping[str, Mapping[Alarm, str]] = {
    "task": {
        Alarm.HANG: "'{subject}' is not responding: {releases} missed since tick {since}",
        Alarm.REJOINED: "'{subject}' rejoined after {span}",
        Alarm.STRAYED: "'{subject}' differs from the two other copies, and is taken out",
        Alarm.TAKEN_OVER: "'{subject}' has taken over: {what}",
        Alarm.NOT_SWITCHED: "'{subject}' remains active: no standby has its state",
        Alarm.LATE: "'{subject}' missed its deadline: still running at its next release",
        Alarm.PLAN_LATE: "'{subject}' missed its deadline: its plan was not finished",
        Alarm.STARVED: "'{subject}' is not getting its core: {releases} missed since tick {since}",
        Alarm.SCHEDULER_KEPT: "'{subject}' goes on as before: {scheduler} refused: {what}",
    },
    "mailbox": {
        Alarm.FLOWS: "'{subject}': messages flow again, {span} after a fault",
        Alarm.STALE: "'{subject}' is stale, {span}: its writer '{writer}' is dead or stopped",
        Alarm.MUTE: "'{subject}' is stale, {span}: '{writer}' is running but not writing",
        Alarm.GAP: "'{subject}': {messages} lost, gap in serials",
        Alarm.HELD_BACK: "'{subject}': a message was delayed by {span}",
        Alarm.DISORDER: "'{subject}': messages out of order, the last one by {span}",
        Alarm.DAMAGED: "'{subject}': a message failed its check",
        Alarm.BABBLE: "'{subject}': '{writer}' writes {value:g} messages per cycle instead of 1",
        Alarm.MASQUERADE: (
            "'{subject}': a message comes from process {value:.0f}, which is not its writer"
        ),
        Alarm.QUEUE_FULL: "'{subject}' is full: {messages} of '{writer}' refused",
        Alarm.INBOX_FULL: "inbox is full: {messages} in '{subject}' lost",
        Alarm.LOCKED: "'{subject}': a dead or stopped process holds the lock",
        Alarm.DIFFERS: "'{subject}': a standby computes another {what}",
    },
    "nothing": {
        Alarm.CLOCK_STOPPED: "clock stopped: no tick for {span}",
        Alarm.CLOCK_SKIPPED: "clock skipped {ticks}",
        Alarm.CLOCK_LATE: "clock late: tick {late_ms:.3f} ms late",
        Alarm.SENSOR_SILENT: "sensors silent: no new sample for {span}",
        Alarm.SENSOR_LATE: "samples late: {span} old",
        Alarm.FORCE_LIMIT: "contact too strong: force of {value:.3g} N",
        Alarm.MOMENT_LIMIT: "contact too strong: torque of {value:.3g} N m",
    },
    "joint": {
        Alarm.SENSOR_RANGE: "sensor {subject} out of range: {value:g} rad",
        Alarm.SENSOR_STUCK: (
            "sensor {subject} stuck: unchanged for {value:.0f} cycles while the arm is driven"
        ),
        Alarm.SENSOR_MODEL: "sensor {subject} disagrees with the model: off by {value:.3g}",
        Alarm.ACTUATOR: "{subject} does not move as its torque commands: off by {value:.3g}",
        Alarm.COMMAND_INVALID: "rejected: torque of {subject} is NaN",
        Alarm.COMMAND_LIMIT: "torque of {subject} cut to its limit: {value:.3g} N m was commanded",
        Alarm.SET_POINT: "rejected: set point of {subject} is {value:.3g} rad from the joint",
        Alarm.LIMIT_EXCEEDED: "{subject} is beyond its limit: {value:.4g}",
        Alarm.TENSION_INVALID: "rejected: a tension of {subject} is NaN",
        Alarm.TENSION_LIMIT: "tension of {subject} cut to its limit: {value:.3g} N was commanded",
        Alarm.TENDON: "tendon of {subject} is slack: {value:.3g} N",
        Alarm.RE_REFERENCED: "sensor {subject} trusted again: {value:.3g} rad from its estimate",
        Alarm.LATCHED: "fault of {subject} latched at {value:.4g}: brakes stay engaged",
    },
    "brakes": {
        Alarm.BRAKES_CLOSED: "brakes engaged: {subject}{lasted}",
        Alarm.BRAKES_OPENED: "brakes released after {span}",
    },
    "fault": {
        Alarm.FAULT_BEGINS: "{what} begins{lasts}",
        Alarm.FAULT_ENDS: "{what} ends; acted {times}",
    },
    "command": {
        Alarm.COMMANDED: "{what} (command {value:.0f})",
        Alarm.OPERATOR_GONE: "{what}: its operator is gone: hold (command {value:.0f})",
    },
    "demand": {Alarm.DEMAND: "{what}"},
    "finding": {Alarm.OWN: "{what}"},
    "geom": {Alarm.COLLISION: "unintended contact: '{subject}' touches '{writer}'"},
    "name": {
        Alarm.MODIFICATION: "control modification '{subject}' failed and was taken out",
        Alarm.PEER_LOST: "rack '{subject}' is lost: its network adapter ended, or is out of reach",
        Alarm.PEER_BACK: "rack '{subject}' is back after {span}",
        Alarm.PEER_RESTARTED: "rack '{subject}' is back after {span}: it was restarted",
        Alarm.REMOTE_STOP: "'{subject}' has set the emergency stop from another machine",
    },
}


class ReadAlarm(NamedTuple):
    """An alarm that was read from a ring: its code, its subject (see `Alarm`) and its event."""

    alarm: Alarm
    subject: int
    event: Event


class AlarmReader:
    """Reader of all alarm rings of a rack, which converts alarms to events.

    Attributes:
        lost: Number of alarms that were overwritten before they were read.
    """

    def __init__(self, segment: Segment) -> None:
        config = read_stored(segment.config)
        self._layout = layout = segment.layout
        self._rings = {
            name: open_alarm_ring(segment, name)
            for name in (CLOCK, *(task.name for task in layout.tasks))
        }
        self._faults = FaultTable(segment)
        self._operator = OperatorTable(segment)
        self._joints = config.joints
        # The cell is built only when the first collision is reported.
        self._geom = str if config.robot is None else partial(find_geom_name, config)
        self._levels = PublishedRack.read_from_segment(segment).levels
        self.lost = 0

    def read_alarms(self) -> list[ReadAlarm]:
        """Return all alarms raised since the last call, sorted by tick and then by time."""
        alarms: list[ReadAlarm] = []
        for owner, ring in self._rings.items():
            if ring.waiting_count:
                rows, lost = ring.read_new_rows()
                self.lost += lost
                alarms += [self.read_row(row, owner) for row in rows]
        return sorted(alarms, key=lambda alarm: (alarm.event.tick, alarm.event.time_ns))

    def read_row(self, row: np.void, owner: str) -> ReadAlarm:
        """Convert a row of an alarm ring, and describe the alarm as an event.

        `Event.board` is the board that raised the alarm, or for a fault, restart or command, the
        board that it affects.

        Args:
            row: A record of type `rack.backplane.watch.alarms.RECORD`.
            owner: The task from whose ring the record was read.

        Raises:
            DamageError: The record refers to a fault, command, task or other item that does not
                exist.
        """
        alarm = to_enum(Alarm, row["code"])
        about, text = next((kind, texts[alarm]) for kind, texts in TEXTS.items() if alarm in texts)
        number = int(row["subject"])
        value = float(row["value"])
        since = int(row["since"])
        kind = EVENT_KINDS.get(alarm, "detection")
        code = alarm.name.lower()
        words: dict[str, object] = {}
        if about == "fault":
            entry = select_item(self._faults.entries, number, "fault")
            layout, joints = self._layout, self._joints
            subject = find_subject(entry, layout, joints)
            board = find_board(entry, layout)
            code = "begins" if alarm == Alarm.FAULT_BEGINS else "ends"
            words["what"] = describe_fault(entry, layout, joints, with_board=False)
            words["lasts"] = f", for {self._format_span(entry.ticks)}" if entry.ticks else ""
            words["times"] = format_count(entry.count, "time")
        elif about == "command":
            request = select_item(self._operator.entries, number, "command")
            subject = board = find_level(request, self._layout)
            message = copy_request_message(request, self._layout)
            words["what"] = describe_command(message)
            if alarm == Alarm.COMMANDED:
                since = -1
                code = to_enum(Operation, message.what).name.lower()
        elif about == "demand":
            demand = to_enum(Demand, value)
            subject = ANOTHER_RACK if number == PEER else self._name_task(number, EMERGENCY_STOP)
            board = owner
            kind = "reaction" if demand else "recovery"
            why = DEMANDED_BY.get(subject, f"'{subject}' is lost")
            words["what"] = DEMANDS[demand].format(why=why)
        elif about == "finding":
            level = self._layout.find_first_copy(owner)
            declared = self._levels[level].findings if level in self._levels else ()
            finding = select_item(declared, number, "finding")
            code = finding.name
            subject = board = owner
            measured = f"{value:.6g} {finding.unit}".removesuffix(" 1")
            detail = bytes(row["text"]).decode("utf-8", "replace") or finding.meaning
            words["what"] = escape_text(f"{code}: {measured}, {detail}")
        else:
            subject = self._name_subject(about, number, owner)
            is_about_task = alarm in (Alarm.REJOINED, Alarm.NOT_SWITCHED, Alarm.SCHEDULER_KEPT)
            board = subject if is_about_task else owner
            words |= self._describe_details(alarm, about, row)
        span = self._format_span(value)
        text = text.format(
            **words,
            subject=subject,
            value=value,
            since=since,
            span=span,
            lasted=f" for {span}" if value else "",
            late_ms=value * 1e-6,
            releases=format_count(value, "release"),
            messages=format_count(value, "message"),
            ticks=format_count(value, "tick"),
        )
        tick = found_at = int(row["tick"])
        if alarm == Alarm.BRAKES_CLOSED and since < found_at:
            # If no board drove the arm when the brakes engaged, the alarm is raised later. The
            # event gets the tick at which they engaged.
            tick = since
            text += f", known at tick {found_at}"
        event = Event(
            time_ns=int(row["time_ns"]) + time.time_ns() - time.monotonic_ns(),
            tick=tick,
            kind=kind,
            board=board,
            text=text,
            code=code,
            fault=number if about == "fault" else -1,
            subject=subject,
            value=value,
            since=since,
        )
        return ReadAlarm(alarm, number, event)

    def _describe_details(self, alarm: Alarm, about: str, row: np.void) -> dict[str, object]:
        """Return further words for the text of an alarm, by name.

        Args:
            alarm: Kind of alarm.
            about: Kind of its subject.
            row: The record of the alarm.
        """
        what = escape_text(bytes(row["text"]).decode("utf-8", "replace"))
        words: dict[str, object] = {"what": what}
        if alarm == Alarm.SCHEDULER_KEPT:
            words["scheduler"] = to_enum(Scheduler, float(row["value"])).word
        elif alarm == Alarm.TAKEN_OVER:
            words["what"] = HAND_OVER_REASONS[to_enum(HandOver, float(row["value"]))]
        elif about == "mailbox":
            words["writer"] = self._layout.mailboxes[int(row["subject"])].writer
        elif about == "geom":
            words["writer"] = self._geom(to_integer(float(row["value"])))
        return words

    def _name_subject(self, about: str, number: int, owner: str) -> str:
        """Return the name of an alarm's subject. Raises `DamageError` if there is no such subject.

        Args:
            about: Kind of the subject.
            number: Number of the subject.
            owner: Task that raised the alarm.
        """
        match about:
            case "task":
                return self._name_task(number, CLOCK if number == -1 else CLOCK_STANDBY)
            case "mailbox":
                return select_item(self._layout.mailboxes, number, "mailbox").name
            case "joint":
                return format_joint(number, self._joints)
            case "geom":
                return self._geom(number)
            case "name":
                level = self._layout.find_first_copy(owner)
                names = self._levels[level].names if level in self._levels else ()
                return select_item(names, number, "name")
            case "brakes" if number > 0:
                return to_enum(Error, number).name.lower()
            case "brakes":
                return select_item(ENGAGED_BY, -number, "reason to brake")
            case _:
                return ""

    def _name_task(self, number: int, other: str) -> str:
        """Return the name of a task by its number, or `other` for a negative number."""
        return select_item(self._layout.processes, number, "task").name if number >= 0 else other

    def _format_span(self, ticks: float) -> str:
        """Return a number of ticks as text, with the simulated time in ms in parentheses."""
        return f"{format_count(ticks, 'tick')} ({ticks * self._layout.clock_ns * 1e-6:g} ms)"
