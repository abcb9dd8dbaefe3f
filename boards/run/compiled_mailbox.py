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
from rack.boards.run.instructions import (
    MONOTONIC,
    clock_gettime,
    copy,
    fence,
    load,
    load_acquire,
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
    *("every", "late_from", "quiet"),  # ticks
    "result",  # of the last read
)
"""A mailbox to read."""
WRITE_PORT = _words(
    # Addresses: the mailbox's head and first slot; the local record of the writer; the addresses of
    # the states of the readers that its message rests on.
    *("head", "slots", "record", "sources"),
    *("source_count", "stride", "depth", "size"),
    *("every", "ahead", "phase", "delay", "due"),  # ticks
    "visibility",  # SLICED, AT_ONCE or SENT
    "is_enabled",
    "intruder",  # process that has published since this writer's last message; 0: none
    *("time_s", "time_ns"),
)
"""A mailbox to write."""
STATE = _words(
    *("serial", "found", "newest", "visible", "basis", "accesses", "transfers", "signature"),
    *("judged", "judged_tick"),
)
"""The words of a reader: see `ReaderState`."""
SLOT = _words("stamp", "signature", "chain", "check", "basis", "serial", "tick", "visible")
"""The words of a slot's head: see `rack.backplane.words.Slot`."""


def place_of(name: str, dtype: np.dtype) -> int:
    """Return the place of a word in a record, bytes."""
    assert dtype.names is not None
    return 8 * dtype.names.index(name)


_SIGNATURE, _SERIAL, _TICK, _VISIBLE = (
    place_of(name, SLOT) for name in ("signature", "serial", "tick", "visible")
)
_TIME = place_of("time_s", WRITE_PORT)
_READ_SIZE = READ_PORT.itemsize
_WRITE_SIZE = WRITE_PORT.itemsize
OLD, NEW, ODD, SILENT, SLOW = 0, 1, 2, 4, 8
"""Results of a read. ODD, SILENT: Python judges messages, silence. SLOW: Python reads."""
SLICED, AT_ONCE, SENT = 0, 1, 2
"""A message is visible at the end of its cycle, as soon as it is whole, or once it is sent."""
MOST_PORTS = 60
"""Most ports of a table: each has a bit in the answer of a call."""
LATE = 1 << MOST_PORTS
"""Bit in the answer of `write_ports`: a message was too late."""
IN_TIME = -1
"""The clock's tick for `write_ports` while the end of the cycle has not come."""


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
def is_kept(port: Any, serial: int) -> bool:
    """Whether that serial's slot has not been reused by now: see `Slots.keeps`."""
    fence()
    oldest: int = load(port.head) + 2 - port.depth
    return serial >= oldest


@compiled
def is_whole(address: int, size: int) -> bool:
    """Whether the message after the head at an address passes its check."""
    head = slot_at(address)
    check: int = head.check
    found: int = xxh3(address + CHECKED_FROM, size - CHECKED_FROM, head.chain)
    return check == found


@compiled
def find_visible(port: Any, last: int, head: int, tick: int) -> int:
    """Return the serial of the newest message visible at `tick`, not before `last`."""
    serial = head
    oldest = max(last, head - port.depth) if head > last else last
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
    if (
        found.serial != serial
        or found.signature != state.signature
        or not is_whole(port.record, port.size)
    ):
        return False
    copy(port.good, port.record, port.size)
    state.serial = serial
    state.newest = found.tick
    state.visible = found.visible
    state.basis = found.basis
    state.transfers += 1
    return True


@compiled
def is_usual(port: Any, serial: int, before: int) -> bool:
    """Whether a message is in its slot, in time, and released after tick `before`; whole, unless
    it was taken. See `MessageWatch._walk`."""
    slot = slot_of(port, serial)
    return (
        load(slot + _SERIAL) == serial
        and before < load(slot + _TICK) > load(slot + _VISIBLE) - port.late_from
        and (serial == state_at(port.state).serial or is_whole(slot, port.size))
        and is_kept(port, serial)
    )


@compiled
def judge(port: Any, found: int) -> bool:
    """Judge the messages up to the newest found; change nothing and return False if one is odd. See
    `MessageWatch.judge`."""
    state = state_at(port.state)
    seen = state.judged
    judged_tick = state.judged_tick
    if seen < 0 or found <= seen:
        return False
    if found == seen + 1:
        if not judged_tick < state.newest > state.visible - port.late_from:
            return False
    else:
        # More messages than releases are a babble.
        releases = (state.newest - judged_tick) // port.every
        if not is_kept(port, found) or found - seen > releases + 1:
            return False
        for serial in range(max(seen + 1, load(port.head) + 2 - port.depth), found):
            if not is_usual(port, serial, judged_tick):
                return False
            judged_tick = load(slot_of(port, serial) + _TICK)
        if not is_usual(port, found, judged_tick):
            return False
    state.judged = found
    state.judged_tick = state.newest
    return True


@compiled
def read_port(address: int, tick: int) -> int:
    """Read one mailbox as `WatchedReader.read` does; return the result."""
    port = read_port_at(address)
    state = state_at(port.state)
    serial = load_acquire(port.head)
    if port.is_sliced and serial != state.serial:
        serial = find_visible(port, state.serial, serial, tick)
    result = OLD
    if serial != state.serial:
        if not port.is_watched or not take(port, serial):
            return SLOW
        result = NEW
    state.accesses += 1
    state.found = serial
    if port.is_watched:
        if serial != state.judged and not judge(port, serial):
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
def visible_at(port: Any, tick: int, now: int) -> int:
    """Return the tick from which a message is visible: see `Writer.visible_at` and those of other
    protocols."""
    visible: int = tick + port.delay
    if port.visibility == AT_ONCE:
        visible = tick if now == IN_TIME else now
    elif now != IN_TIME and port.visibility == SENT:
        visible = port.delay + max(tick, now - port.due + 1)
    elif now >= visible:
        cycle = min(port.every, port.delay)
        visible = now + cycle - (now - port.phase) % cycle
    return visible


@compiled
def publish(address: int, tick: int, visible: int, basis: int) -> int:
    """Publish the message of a port's record; return the process of an intruder, 0: none. See
    `Slots.publish`."""
    port = write_port_at(address)
    record = slot_at(port.record)
    before = record.serial
    slot = slot_of(port, before + 1)
    intruder = 0
    if load(port.head) != before:
        intruder = load(slot + _SIGNATURE) >> EPOCH_BITS
    record.basis = basis
    record.serial = before + 1
    record.tick = tick
    record.visible = visible
    record.chain = record.check
    record.check = xxh3(port.record + CHECKED_FROM, port.size - CHECKED_FROM, record.chain)
    clock_gettime(MONOTONIC, address + _TIME)
    record.stamp = port.time_s * 1_000_000_000 + port.time_ns
    # In this order: the previous head, the message, its signature, this head.
    fence()
    copy(slot + SIGNED_FROM, port.record + SIGNED_FROM, port.size - SIGNED_FROM)
    fence()
    copy(slot, port.record, SIGNED_FROM)
    store_release(port.head, before + 1)
    return intruder


@compiled_for("i8, i8, i8, i8")
def write_ports(table: int, count: int, tick: int, now: int) -> int:
    """Write the messages that are due.

    Args:
        table: Address of the ports, of type `WRITE_PORT`.
        count: Number of them.
        tick: Release tick of the cycle.
        now: The clock's tick if the cycle's end may have passed, otherwise IN_TIME.

    Returns:
        A bit for each port with an intruder, and LATE if a message was too late.
    """
    answer = 0
    for at in range(count):
        address = table + at * _WRITE_SIZE
        port = write_port_at(address)
        if not port.is_enabled or (tick + port.ahead) % port.every:
            continue
        basis = basis_of(port, tick)
        port.intruder = publish(address, tick, visible_at(port, tick, now), basis)
        if port.intruder:
            answer |= 1 << at
        if now != IN_TIME and now >= tick + port.due:
            answer |= LATE
    return answer


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
