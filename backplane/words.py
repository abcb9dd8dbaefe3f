"""The shared words: every number on the backplane outside messages, by name.

Each is an aligned 64-bit integer with one writer, stored and loaded whole through a memoryview cast
to 'q'. (`struct` packs byte by byte: a reader could see half a number.) Their places are plain
integers: a member of an enum takes as long to look up as three words take to read.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol


class OnWords(Protocol):
    """What consists of words of shared memory."""

    words: memoryview


class Word:
    """A word at a place among the `words` of an object, as an attribute."""

    def __init__(self, place: int) -> None:
        self._place = place

    def __get__(self, owner: OnWords, kind: type) -> int:
        return owner.words[self._place]

    def __set__(self, owner: OnWords, value: int) -> None:
        owner.words[self._place] = value


def switch(tick: int, is_on: bool) -> int:
    """Return the value of a word that switches on, or off, at `tick`: until then the opposite
    holds.

    So readers agree on it by ticks alone, whenever they look. Each switch follows the opposite one;
    0: never on.
    """
    return 2 * tick + is_on


def is_on(word: int, tick: int) -> bool:
    """Say whether such a word is on at `tick`."""
    return bool(word & 1) == (tick >= word >> 1)


class Head:
    """Words at the head of the segment, written once by the Rack."""

    MAGIC = 0
    VERSION = 1
    SIZE = 2
    LAUNCHER_PID = 3  # the launcher holds the kernel's lock on this word
    LAUNCHER_NAMESPACE = 4  # inode of the launcher's PID namespace
    CREATED_NS = 5  # CLOCK_REALTIME
    LAYOUT_AT = 6
    LAYOUT_SIZE = 7
    CONFIG_AT = 8
    CONFIG_SIZE = 9
    CREATED_MONOTONIC_NS = 10  # the same moment as CREATED_NS, CLOCK_MONOTONIC
    PUBLISHED_AT = 11
    PUBLISHED_SIZE = 12
    CHECK = 13  # CRC-32 of the three texts


class System:
    """Words of the system clock and the utility lines, after those of the head."""

    STATE = 32  # Run
    TICK = 33
    EPOCH_NS = 34  # CLOCK_MONOTONIC of tick 0
    PERIOD_NS = 35  # wall-clock time from tick to tick: the clock's period over the speed factor
    LOCKSTEP = 36
    STOP_REQUEST = 37  # written by the host
    STOP_TICK = 38  # first tick after the run; 0: not known
    CLOCK_SKIPPED = 39  # ticks skipped by the clock itself
    FOLLOWER_PID = 40  # of the recorder for which lockstep waits; 0: none
    FOLLOWER_TICK = 41  # everything up to here is recorded
    TICK_NS = 42  # CLOCK_MONOTONIC of the newest tick
    # rises with every change in the fault table that concerns tasks; written by the clock
    FAULTS = 43
    DEMAND = 44  # Demand of the utility lines on the arm; written by the clock
    CLOCK_PID = 45
    INJECTED = 46  # faults put into the fault table so far
    LOSSES = 47  # rises by 2 for each board found dead; odd while the crate records it
    SYSRESET = 48
    ACFAIL = 49
    EMERGENCY_STOP = 50
    REQUESTED = 51  # commands put into the operator table so far
    COMMANDED = 52  # serial of the newest command issued; written by the clock
    # 1 + tick before which lockstep holds, for single steps; 0: it does not. Written by the host
    HOLD_AT = 53
    HELD = 54  # 1 + tick before which it holds now; 0: it does not. Written by the clock
    # while another rack is lost, the arm is to stop: see `switch`. Written by the network adapter
    PEER_STOP = 55
    SKIPPED_FROM = 56  # first of the ticks that the clock skipped last
    # the recorder has taken everything up to here, whether or not it is in its files
    FOLLOWER_DRAINED = 57
    # 1 + tick before which lockstep takes a snapshot; 0: none is wanted. Written by the Rack
    SNAPSHOT_AT = 58
    # snapshots cost one part in so many of lockstep's time; 0: there is only that one. By the Rack
    SNAPSHOT_PART = 59
    SNAPSHOT_EVERY = 60  # ticks between two that are taken besides; 0: none. Written by the Rack
    SNAPSHOTS = 61  # held by the crate, of this rack or of those before it; written by the crate
    SNAPSHOT_BYTES = 62  # the memory that they have for themselves; written by the crate
    SYSFAIL = 64  # one word per slot, 22 of them: 1 until the board's self-test has passed


class Run(IntEnum):
    """Values of `System.STATE`."""

    STARTING = 0
    RUNNING = 1
    STOPPED = 2


class Demand(IntEnum):
    """Values of `System.DEMAND`: the demand of the rack's safety on the arm; a greater one is
    stronger.
    """

    NONE = 0
    STOP = 1  # controlled stop: ramp to rest, then brake
    BRAKE = 2  # brake at once


class Block:
    """Words of a task's control block, written by the task; RELEASED by the clock, LOST by the
    finder of a loss.

    A host board has one too. In lockstep its bus adapter releases it: see
    `rack.boards.host.bus_adapter`.
    """

    RELEASED = 0  # newest release, as a tick; -1: none yet. Of a batch: its last
    DEADLINE = 1  # tick before which that cycle, or plan, must be finished
    DONE = 2  # newest release that is finished; -1: none yet
    PID = 3
    STATE = 4  # TaskState
    CYCLES = 5
    MISSED = 6
    SKIPPED = 7
    PRIORITY = 8  # SCHED_FIFO priority obtained; 0: ordinary scheduling
    CORE = 9
    READS = 10
    READ_BYTES = 11
    WRITES = 12
    WRITE_BYTES = 13
    CORRUPT = 14  # messages that failed their check
    BUS_ERRORS = 15  # accesses cut off by their bound
    TRACE_HEAD = 16  # trace records written
    LEVEL_STATE = 17  # state of the level, as in its status
    PLANS = 18  # plans made
    # 1 + tick at which the task was found dead or hanging; 0: not lost. The clock clears it
    LOST = 19
    LEVEL_SINCE = 20  # tick of the cycle in which the level entered that state
    # of the network adapter in lockstep: the rack that its cycle awaits; 0: none. See
    # boards.lan.awaited
    AWAITS = 21
    # messages that have interrupted this board and were served, under protocol interrupt
    INTERRUPTS = 22
    INTERRUPTS_LOST = 23  # those lost because too many waited
    INTERRUPTS_WAITING = 24  # the largest number that has waited
    CLOCK_SKIPPED = 25  # ticks skipped by the clock that this task has reported
    # of a host board in lockstep: tick until which its program waits; 0: a message has come
    WAITS_UNTIL = 26
    # 1 + tick before which the task is to fork a copy; 0: it is not, or has. Set by the clock
    COPY = 27
    TRACE_FIRST = 28  # trace records before this run, which continues another; written by the crate
    FIRST = 29  # in lockstep, first of the releases given together with RELEASED; by the clock
    FAILED = 30  # where in its code the last process of the task failed, and how often in a row


class TaskState(IntEnum):
    """Values of `Block.STATE`."""

    ABSENT = 0
    STARTING = 1
    READY = 2
    RUNNING = 3
    ENDED = 4
    FAILED = 5
    GIVEN_UP = 6  # lost, and not to be restarted; written by the Rack


class Box:
    """Words at the head of a mailbox."""

    HEAD = 0  # serial of the newest whole message; 0: none
    EPOCH = 1  # counts the writers that have claimed the mailbox
    WRITER_PID = 2
    CLAIM = 3  # no value: the writer holds the kernel's lock on this address
    # the same for the critical section of protocol lock; value: its owner's process id, 0: none
    OWNER = 4
    # epoch and process of the writer in one number, as in every slot that it fills: `slots.claim`
    CLAIMANT = 5
    REFUSED = 6  # of a queue: messages refused because it was full
    # of a queue: serial of the newest message of its own writer; HEAD is greater while another has
    # published
    SENT = 7
    # in a host board's mailbox: serial of the newest message that its bus adapter has taken
    TAKEN = 8
    # of what comes from another rack, while that is lost: its writer counts as lost. See `switch`
    VOID = 9
    KEPT = 10  # the same, for racks that go on: its information does not grow too old. See `switch`
    # of a queue: serial of the newest message taken, times 3: see `queue.QueueReader`
    POSITION = 11
    FIRST = 12  # serial of the newest message before this run: see `Block.TRACE_FIRST`


class Slot:
    """Words in front of every message in its slot.

    The checksum covers BASIS to the end of the message and, as it is seeded with CHAIN, the
    checksum of the message before, all earlier messages. It does not cover time stamp and writer,
    so that equal runs have equal checksums.
    """

    STAMP_NS = 0
    EPOCH = 1
    CHAIN = 2
    CHECK = 3
    BASIS = 4
    SERIAL = 5
    TICK = 6
    VISIBLE_AT = 7
