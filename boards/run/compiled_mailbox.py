"""Mailboxes accessed by compiled code, with one call for all ports of a step of the cycle.

In the usual case, a call does the same as `WatchedReader.read` and `OutputPort.write`, on the same
memory: the slots, the local records, and the words of a reader's state. In rare cases (the first
message of a writer, a damaged, lost or forged message, a silent writer) it reports the port, and
the Python classes, which remain the reference implementation, handle the access.

Loads and stores of heads are atomic, with acquire and release: see `rack.backplane.mailbox.slots`.
Addresses stay valid in a fork and in a copy of a board, whose memory is at the same place.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rack.backplane.mailbox.mailbox import GOOD_OFFSET, NO_MESSAGE_TICK
from rack.backplane.mailbox.slots import CHECKED_FROM, EPOCH_MASK, SIGNED_FROM, Slots
from rack.backplane.words import Box, Slot
from rack.boards.run.instructions import (
    copy,
    fence,
    instruction,
    load,
    store_release,
    to_pointer,
    xxh3,
)
from rack.levels.compiled import compiled, compiled_for


def _build_dtype(*names: str) -> np.dtype:
    """Build a numpy dtype with a signed 64-bit field for each name."""
    return np.dtype([(name, "i8") for name in names])


SLOT = _build_dtype("stamp", "signature", "chain", "check", "basis", "serial", "tick", "visible")
"""Words of a slot's head: see `rack.backplane.words.Slot`."""
STATE = _build_dtype("found", "accesses", "transfers", "judged", "judged_tick", *(SLOT.names or ()))
"""Words of a reader's state: see `Reader`."""
PORT = _build_dtype(
    # Addresses of the mailbox's head, of its first slot, and of the local record of its reader or
    # writer.
    "head",
    "slots",
    "record",
    # The slots: distance between two in bytes, number of slots, and bytes used in each.
    "stride",
    "depth",
    "size",
    # For reading: addresses of the reader's state and of the word that marks the writer as lost,
    # whether visibility depends on ticks, and whether compiled code accepts and checks messages.
    "state",
    "lost",
    "is_sliced",
    "is_watched",
    "late_from",
    "quiet",  # ticks
    # For writing: address and length of an array of addresses. Each is the address of the state of
    # a reader on whose messages the written message depends.
    "sources",
    "source_count",
    # Period, 0 for a mailbox to read; phase; time until a message is visible. In ticks.
    "every",
    "ahead",
    "delay",
    # Result of the last read, or the signature of an intruder found by the last write.
    "result",
)
"""Record type of a mailbox that compiled code reads or writes."""
_SIGNATURE = 8 * Slot.EPOCH
_VISIBLE = 8 * Slot.VISIBLE_AT
_CLAIMANT = 8 * Box.CLAIMANT
_PORT_SIZE = PORT.itemsize
OLD_RESULT, NEW_RESULT, CHECK_MESSAGES, CHECK_SILENCE, READ_IN_PYTHON = 0, 1, 2, 4, 8
"""Results of a read, of which the last three are bits that can be combined.

They request that Python check the messages, check the writer's silence, or make the whole read.
"""


# Functions that return the record at an address, for compiled code.
port_at = instruction(to_pointer, PORT)
state_at = instruction(to_pointer, STATE)
slot_at = instruction(to_pointer, SLOT)


@compiled
def slot_of(port: Any, serial: int) -> int:
    """Return the address of the slot for a serial, in the mailbox of a port."""
    slot: int = port.slots + (serial & (port.depth - 1)) * port.stride
    return slot


@compiled
def take(port: Any, serial: int) -> bool:
    """Accept a message as `Reader._fetch_good` does, if it is good and its writer is known.

    Args:
        port: Port to read, a record of type `PORT`.
        serial: Serial of the message.

    Returns:
        False if Python must handle the message, because it is bad or from a new or former writer.
    """
    slot = slot_of(port, serial)
    copy(port.record, slot, SIGNED_FROM)
    fence()
    copy(port.record + SIGNED_FROM, slot + SIGNED_FROM, port.size - SIGNED_FROM)
    fence()
    received = slot_at(port.record)
    state = state_at(port.state)
    if received.serial != serial or received.signature != state.signature:
        return False
    check = received.check ^ (received.signature & EPOCH_MASK)
    if xxh3(port.record + CHECKED_FROM, port.size - CHECKED_FROM, received.chain) != check:
        return False
    if received.signature != load(port.head + _CLAIMANT):
        return False
    copy(port.state + GOOD_OFFSET, port.record, port.size)
    state.transfers += 1
    return True


@compiled
def read_port(port: Any, tick: int) -> int:
    """Read one mailbox as `WatchedReader.read` does.

    Args:
        port: Port to read, a record of type `PORT`.
        tick: Release tick of the cycle.

    Returns:
        `OLD_RESULT` or `NEW_RESULT`, combined with the bits that request checks. `READ_IN_PYTHON`
            alone if Python must read the mailbox instead.
    """
    state = state_at(port.state)
    serial = load(port.head)
    oldest = max(state.serial, serial - port.depth)
    while port.is_sliced and serial > oldest and load(slot_of(port, serial) + _VISIBLE) > tick:
        serial -= 1
    result = OLD_RESULT
    if serial > state.serial:
        if not port.is_watched or not take(port, serial):
            return READ_IN_PYTHON
        result = NEW_RESULT
    state.accesses += 1
    state.found = serial
    if port.is_watched:
        # In the usual case there is no new message, or exactly one, which is in time and from a
        # later release than the message before it.
        if 0 <= state.judged == serial - 1 and (
            state.judged_tick < state.tick > state.visible - port.late_from
        ):
            state.judged = serial
            state.judged_tick = state.tick
        elif serial != state.judged:
            result |= CHECK_MESSAGES
        if tick - state.tick >= port.quiet or load(port.lost):
            result |= CHECK_SILENCE
    return result


@compiled
def publish(port: Any, tick: int, stamp: int) -> int:
    """Publish the message in a port's local record as `Slots.publish_message` does.

    Args:
        port: Port to write, a record of type `PORT`.
        tick: Release tick of the cycle.
        stamp: Time stamp of the message, in ns of CLOCK_MONOTONIC.

    Returns:
        Signature of an intruder, 0 for none.
    """
    record = slot_at(port.record)
    before = record.serial
    slot = slot_of(port, before + 1)
    intruder = 0
    if load(port.head) != before:
        intruder = load(slot + _SIGNATURE)
    basis = NO_MESSAGE_TICK
    for at in range(port.source_count):
        state = state_at(load(port.sources + 8 * at))
        if state.serial:
            basis = min(basis, state.basis)
    record.stamp = stamp
    record.basis = tick if basis == NO_MESSAGE_TICK else basis
    record.serial = before + 1
    record.tick = tick
    record.visible = tick + port.delay
    epoch = record.signature & EPOCH_MASK
    record.chain = record.check ^ epoch
    record.check = xxh3(port.record + CHECKED_FROM, port.size - CHECKED_FROM, record.chain) ^ epoch
    # Other processes must see the stores in this order: the mailbox's head for the previous
    # message, this message, its signature, and the mailbox's head for this message.
    fence()
    copy(slot + SIGNED_FROM, port.record + SIGNED_FROM, port.size - SIGNED_FROM)
    fence()
    copy(slot, port.record, SIGNED_FROM)
    store_release(port.head, before + 1)
    return intruder


@compiled_for("i8, i8, i8, i8")
def access_ports(table: int, count: int, tick: int, stamp: int) -> bool:
    """Read mailboxes as of a tick, and write the messages that are due.

    Args:
        table: Address of the ports, records of type `PORT`.
        count: Number of ports.
        tick: Release tick of the cycle, which must not be late yet.
        stamp: Time stamp of written messages, in ns of CLOCK_MONOTONIC.

    Returns:
        True if Python must handle the results, because one has changed, requests a check or is the
            signature of an intruder.
    """
    must_handle = False
    for at in range(count):
        port = port_at(table + at * _PORT_SIZE)
        result = 0
        if port.every == 0:
            result = read_port(port, tick)
        elif (tick + port.ahead) % port.every == 0:
            result = publish(port, tick, stamp)
        if result > NEW_RESULT or result != port.result:
            must_handle = True
        port.result = result
    return must_handle


@compiled
def order() -> None:
    """Execute a memory fence. Implements `Slots.fence` on any processor."""
    fence()


def load_machine_code() -> None:
    """Load the compiled functions of this module, and replace `Slots.fence` with one of them.

    The crate calls this before it forks boards.
    """
    access_ports.preload()
    Slots.fence = staticmethod(order.load_machine_code())  # type: ignore[method-assign]  # the reference needs none on x86-64
    Slots.fence()
