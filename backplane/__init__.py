"""The backplane: one shared-memory segment per rack, with mailboxes, a clock and watches.

A level's author needs `Message`, `Command`, `Status` and `field` to declare messages, `State` for
their statuses, and `Reading` with its `Verdict` for input ports. A program that inspects a running
rack needs the other names:

    from rack.backplane import Segment, open_observer

    segment = Segment.attach("nasrem")
    print(open_observer(segment, "servo.status").peek().message)

- `Segment` is a rack's memory. `Layout` describes its mailboxes and tasks as plain data
  (`MailboxSpec`, `TaskSpec`).
- `open_writer` and `open_reader` open a mailbox under its protocol. `open_observer` never takes its
  lock.
- `SystemClock` reads the clock, `Alarm` lists the kinds of alarms, and `Demand` lists the stops
  that the safety functions can impose on the arm.
- `BackplaneError` is the root of all errors of this package.

Names are imported on first use, because importing numpy takes a tenth of a second, which commands
such as `rack list` need not wait for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.exports import build_lazy_getattr

if TYPE_CHECKING:
    from rack.backplane.clock.system_clock import SystemClock
    from rack.backplane.errors import BackplaneError
    from rack.backplane.layout import Layout, MailboxSpec, TaskSpec
    from rack.backplane.mailbox.mailbox import Reading, Verdict
    from rack.backplane.mailbox.protocols import open_observer, open_reader, open_writer
    from rack.backplane.message import Command, Message, State, Status, field
    from rack.backplane.segment import Segment
    from rack.backplane.watch.alarms import Alarm
    from rack.backplane.words import Demand

__all__ = [
    "Alarm",
    "BackplaneError",
    "Command",
    "Demand",
    "Layout",
    "MailboxSpec",
    "Message",
    "Reading",
    "Segment",
    "State",
    "Status",
    "SystemClock",
    "TaskSpec",
    "Verdict",
    "field",
    "open_observer",
    "open_reader",
    "open_writer",
]
_PLACES = {
    "rack.backplane.clock.system_clock": ("SystemClock",),
    "rack.backplane.errors": ("BackplaneError",),
    "rack.backplane.layout": ("Layout", "MailboxSpec", "TaskSpec"),
    "rack.backplane.mailbox.mailbox": ("Reading", "Verdict"),
    "rack.backplane.mailbox.protocols": ("open_observer", "open_reader", "open_writer"),
    "rack.backplane.message": ("Command", "Message", "State", "Status", "field"),
    "rack.backplane.segment": ("Segment",),
    "rack.backplane.watch.alarms": ("Alarm",),
    "rack.backplane.words": ("Demand",),
}

if not TYPE_CHECKING:  # a type checker would take every misspelt name for one of these
    __getattr__ = build_lazy_getattr(__name__, _PLACES)
