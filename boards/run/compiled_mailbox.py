"""Mailboxes read and written by machine code: one call for all ports of a step of the cycle.

A call does what `WatchedReader.read` and `OutputPort.write` do in the usual case, on the same
memory: the slots, the local records, and the words of a reader's state. What is rare (the first
message of a writer, a damaged, lost or forged one, a silent writer) it leaves as it was, and says
so: then the Python classes do it, which remain the reference.

Loads and stores of heads are atomic, with acquire and release: see `rack.backplane.mailbox.slots`.
Addresses stay valid in a fork and in a copy of a board, whose memory is at the same place.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from rack.backplane.mailbox.slots import CHECKED_FROM, EPOCH_BITS, SIGNED_FROM, Slots
from rack.backplane.words import Slot
from rack.boards.run.instructions import (
    copy,
    fence,
    load,
    record_at,
    store_release,
    xxh3,
)
from rack.levels.compiled import compiled, compiled_for, preload


def _words(*names: str) -> np.dtype:
    return np.dtype([(name, "i8") for name in names])


READ_PORT = _words(
    # Addresses: the mailbox's head and first slot; the state, the last good message and the local
    # record of its reader; the word that says that the writer is lost.
    *("head", "slots", "state", "good", "record", "lost"),
    *("stride", "depth", "size"),  # of slots; bytes from one to the next, and bytes in use
    "is_sliced",  # whether messages are visible by ticks
    "is_watched",  # whether messages are taken and judged here, or Python takes them
    *("late_from", "quiet"),  # ticks
    "result",  # of the last read
)
"""A mailbox to read."""
WRITE_PORT = _words(
    # Addresses: the mailbox's head and first slot; the local record of the writer; the addresses of
    # the states of the readers that its message rests on.
    *("head", "slots", "record", "sources"),
    *("source_count", "stride", "depth", "size"),
    *("every", "ahead", "delay"),  # ticks; the last until a message is visible
    "intruder",  # process that has published since this writer's last message; 0: none
)
"""A mailbox to write."""
STATE = _words(
    *("serial", "found", "newest", "visible", "basis", "accesses", "transfers", "signature"),
    *("judged", "judged_tick"),
)
"""The words of a reader: see `ReaderState`."""
SLOT = _words("stamp", "signature", "chain", "check", "basis", "serial", "tick", "visible")
"""The words of a slot's head: see `rack.backplane.words.Slot`."""
_SIGNATURE = 8 * Slot.EPOCH
_VISIBLE = 8 * Slot.VISIBLE_AT
_READ_SIZE = READ_PORT.itemsize
_WRITE_SIZE = WRITE_PORT.itemsize
OLD, NEW, ODD, SILENT, SLOW = 0, 1, 2, 4, 8
"""Results of a read. ODD, SILENT: Python judges messages, silence. SLOW: Python reads."""
MOST_PORTS = 60
"""Most ports of a table: each has a bit in the answer of a call."""


read_port_at = record_at(READ_PORT)
write_port_at = record_at(WRITE_PORT)
state_at = record_at(STATE)
slot_at = record_at(SLOT)


@compiled
def slot_of(port: Any, serial: int) -> int:
    """Return the address of the slot of a serial."""
    slot: int = port.slots + (serial & (port.depth - 1)) * port.stride
    return slot


@compiled
def find_visible(port: Any, last: int, head: int, tick: int) -> int:
    """Return the serial of the newest message visible at `tick`, not before `last`."""
    serial = head
    oldest = max(last, head - port.depth)
    while serial > oldest and load(slot_of(port, serial) + _VISIBLE) > tick:
        serial -= 1
    return serial


@compiled
def take(port: Any, serial: int) -> bool:
    """Take a good message of the writer of the last one; leave any other: see `Reader._obtain`."""
    slot = slot_of(port, serial)
    copy(port.record, slot, SIGNED_FROM)
    fence()
    copy(port.record + SIGNED_FROM, slot + SIGNED_FROM, port.size - SIGNED_FROM)
    found = slot_at(port.record)
    state = state_at(port.state)
    if found.serial != serial or found.signature != state.signature:
        return False
    check: int = xxh3(port.record + CHECKED_FROM, port.size - CHECKED_FROM, found.chain)
    if check != found.check:
        return False
    copy(port.good, port.record, port.size)
    state.serial = serial
    state.newest = found.tick
    state.visible = found.visible
    state.basis = found.basis
    state.transfers += 1
    return True


@compiled
def read_port(address: int, tick: int) -> int:
    """Read one mailbox as `WatchedReader.read` does; return the result."""
    port = read_port_at(address)
    state = state_at(port.state)
    serial = load(port.head)
    if port.is_sliced:
        serial = find_visible(port, state.serial, serial, tick)
    result = OLD
    if serial != state.serial:
        if not port.is_watched or not take(port, serial):
            return SLOW
        result = NEW
    state.accesses += 1
    state.found = serial
    if port.is_watched:
        # Usually nothing is new, or the next message is there, released later, in time.
        if 0 <= state.judged == serial - 1 and (
            state.judged_tick < state.newest > state.visible - port.late_from
        ):
            state.judged = serial
            state.judged_tick = state.newest
        elif serial != state.judged:
            result |= ODD
        if tick - state.newest >= port.quiet or load(port.lost):
            result |= SILENT
    return result


@compiled_for("i8, i8, i8")
def read_ports(table: int, count: int, tick: int) -> int:
    """Read mailboxes as of a tick.

    Args:
        table: Address of the ports, of type `READ_PORT`.
        count: Number of them.
        tick: Release tick of the cycle.

    Returns:
        A bit for each port that Python must look at: its result has changed, or is not an ordinary
        one.
    """
    touched = 0
    for at in range(count):
        address = table + at * _READ_SIZE
        result = read_port(address, tick)
        port = read_port_at(address)
        if result > NEW or result != port.result:
            touched |= 1 << at
        port.result = result
    return touched


@compiled
def basis_of(port: Any, tick: int) -> int:
    """Return the tick of the oldest information that a message rests on."""
    basis = tick
    is_first = True
    for at in range(port.source_count):
        state = state_at(load(port.sources + 8 * at))
        if state.serial and (is_first or state.basis < basis):
            basis = state.basis
            is_first = False
    return basis


@compiled
def publish(port: Any, tick: int, stamp: int) -> int:
    """Publish the message of a port's record; return the process of an intruder, 0: none. See
    `Slots.publish`.
    """
    record = slot_at(port.record)
    before = record.serial
    slot = slot_of(port, before + 1)
    intruder = 0
    if load(port.head) != before:
        intruder = load(slot + _SIGNATURE) >> EPOCH_BITS
    record.stamp = stamp
    record.basis = basis_of(port, tick)
    record.serial = before + 1
    record.tick = tick
    record.visible = tick + port.delay
    record.chain = record.check
    record.check = xxh3(port.record + CHECKED_FROM, port.size - CHECKED_FROM, record.chain)
    # In this order: the previous head, the message, its signature, this head.
    fence()
    copy(slot + SIGNED_FROM, port.record + SIGNED_FROM, port.size - SIGNED_FROM)
    fence()
    copy(slot, port.record, SIGNED_FROM)
    store_release(port.head, before + 1)
    return intruder


@compiled_for("i8, i8, i8, i8")
def write_ports(table: int, count: int, tick: int, stamp: int) -> bool:
    """Write the messages that are due.

    Args:
        table: Address of the ports, of type `WRITE_PORT`.
        count: Number of them.
        tick: Release tick of the cycle, whose end has not come.
        stamp: CLOCK_MONOTONIC, ns.

    Returns:
        Whether a port has an intruder.
    """
    is_intruded = False
    for at in range(count):
        port = write_port_at(table + at * _WRITE_SIZE)
        if (tick + port.ahead) % port.every:
            port.intruder = 0
            continue
        port.intruder = publish(port, tick, stamp)
        is_intruded |= port.intruder > 0
    return is_intruded


@compiled
def order() -> None:
    """Do what `Slots.fence` promises, on any processor."""
    fence()


def load_machine_code() -> None:
    """Load all of it, compiled or from the cache: once, before a crate forks its boards."""
    preload(sys.modules[__name__])
    ordering: Any = order.load()
    ordering.compile(())
    Slots.fence = staticmethod(ordering)  # type: ignore[method-assign]  # the reference needs none on x86-64
