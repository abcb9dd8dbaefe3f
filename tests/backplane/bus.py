"""A small bus for tests: a writer's and a reader's task, and the mailboxes of a test."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rack.backplane.address_map import MAILBOX_HEAD_SIZE, SLOT_HEAD_SIZE, compute_slot_stride
from rack.backplane.layout import InterruptSpec, Layout, MailboxSpec, Protocol, Role, TaskSpec, Wake
from rack.backplane.mailbox.queue import QueueTaken, get_position_mailbox
from rack.backplane.message import Message, field
from rack.backplane.segment import Segment
from rack.boards.config.layout import build_field_specs

CLOCK_NS = 2_500_000
SERVICE_NS, SPARE_NS = 60_000, 1_000_000
"""Under protocol interrupt: service of a message, and the time from sending it to the tick that
shows it."""
NAME = "writer.point"
SIZES = {"row": 24}


class Point(Message, version=3):
    id: int = field("u4", unit="1", doc="serial of the message")
    row: np.ndarray = field(
        "i8", unit="1", doc="the serial again in every place: half a message shows", shape="row"
    )
    text: str = field("S8", doc="a word")


def mailbox(
    protocol: Protocol = "time-slice",
    every: int = 1,
    delay: int = 1,
    depth: int = 8,
    name: str = NAME,
    writer: str = "writer",
    capacity: int = 0,
    reader: str = "reader",
    kind: type[Message] = Point,
) -> MailboxSpec:
    """Return the spec of a mailbox, of points by default; under protocol interrupt they are sent
    early enough for `delay`."""
    interrupt = InterruptSpec(delay * CLOCK_NS - SPARE_NS, SERVICE_NS, 16, delay, delay, slots=(3,))
    return MailboxSpec(
        name=name,
        writer=writer,
        readers=(reader,),
        protocol=protocol,
        every=every,
        delay=delay,
        depth=depth,
        message=kind.message_type.name,
        version=kind.message_type.version,
        size=kind.message_type.build_dtype(SIZES).itemsize,
        fields=build_field_specs(kind.message_type, SIZES),
        capacity=capacity,
        interrupt=interrupt if protocol == "interrupt" else None,
    )


def queue(capacity: int, rates: tuple[int, int] = (1, 1)) -> tuple[MailboxSpec, MailboxSpec]:
    """Return the specs of a queue of points and of its reader's position; `rates` are both tasks'
    periods."""
    written, read = rates
    box = mailbox("queue", every=written, delay=written, depth=64, capacity=capacity)
    name = get_position_mailbox(NAME)
    position = mailbox(
        "time-slice", read, read, 64, name, writer="reader", reader="writer", kind=QueueTaken
    )
    return box, position


def task(
    name: str,
    every: int = 1,
    slot: int = 2,
    role: Role = "executor",
    within_cycles: int = 1,
    depth: int = 16,
    wake: Wake = "signal",
) -> TaskSpec:
    """Return the spec of a task on a board of its own."""
    return TaskSpec(name, name, role, slot, 0, 0, every, within_cycles, depth, wake)


def layout(
    rack: str, mailboxes: Iterable[MailboxSpec] = (), tasks: Iterable[TaskSpec] = ()
) -> Layout:
    """Return a layout. By default it has a writing and a reading task."""
    return Layout(
        rack, CLOCK_NS, tuple(tasks) or (task("writer"), task("reader", slot=3)), tuple(mailboxes)
    )


def message_address(segment: Segment, serial: int, name: str = NAME) -> int:
    """Return the bus address of the message in that serial's slot."""
    spec = segment.layout.find_mailbox(name)
    slot = (serial % spec.depth) * compute_slot_stride(spec)
    return segment.map.mailboxes[name] + MAILBOX_HEAD_SIZE + slot + SLOT_HEAD_SIZE
