"""The backplane: one shared-memory segment per rack, with its mailboxes, its clock, and the watches
on them.

A level's author finds what declares messages, and what reads give, in `rack.levels`. A program that
looks into a running rack needs `segment` and `mailbox.protocols`:

    from rack.backplane.mailbox.protocols import open_observer
    from rack.backplane.segment import Segment

    segment = Segment.attach("nasrem")
    print(open_observer(segment, "servo.status").peek().value)

- `segment.Segment` is a rack's memory, `layout.Layout` its mailboxes and tasks as plain data.
- `mailbox.protocols` opens a mailbox under its protocol; `open_observer` never takes its lock.
- `clock.system_clock.SystemClock` reads the clock; `watch.alarms.Alarm` lists the kinds of alarms;
  `words.Demand` is the demand of safety on the arm.
- `errors.BackplaneError` is the root of all errors of this package.
"""
