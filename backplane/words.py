"""The shared words: every number on the backplane outside messages, by name.

Each is an aligned 64-bit integer with one writer, stored and loaded whole through a memoryview cast
to 'q'. (`struct` packs byte by byte, so a reader could see half a number.) Indices are plain
integers: looking up an enum member takes as long as reading three words.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol


class HasWords(Protocol):
    """Object whose attributes are stored in `words`, a view of shared memory."""

    words: memoryview


class Word:
    """Descriptor for an attribute stored in the `words` of its object, at a fixed index."""

    def __init__(self, index: int) -> None:
        self._index = index

    def __get__(self, owner: HasWords, kind: type) -> int:
        return owner.words[self._index]

    def __set__(self, owner: HasWords, value: int) -> None:
        owner.words[self._index] = value


def encode_switch(tick: int, is_on: bool) -> int:
    """Encode in one word that a state changes at `tick`. `is_switched_on` decodes it.

    Before `tick` the word means the opposite state. The state therefore depends on the reader's
    tick alone, not on the moment at which the word is read. Changes to on and to off must
    alternate. The value 0 stands for a switch that was never on.

    Args:
        tick: First tick of the new state.
        is_on: The new state.
    """
    return 2 * tick + is_on


def is_switched_on(word: int, tick: int) -> bool:
    """Return the state at `tick`, decoded from a word made by `encode_switch`."""
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
    CREATED_MONOTONIC_NS = 10  # time of CREATED_NS on CLOCK_MONOTONIC
    PUBLISHED_AT = 11
    PUBLISHED_SIZE = 12
    CHECK = 13  # CRC-32 of the three texts


class System:
    """Words of the system clock and the utility lines, after the words of the head."""

    STATE = 32  # Run
    TICK = 33
    EPOCH_NS = 34  # CLOCK_MONOTONIC of tick 0
    PERIOD_NS = 35  # wall-clock time from tick to tick: the clock's period over the speed factor
    LOCKSTEP = 36
    STOP_REQUEST = 37  # written by the host
    STOP_TICK = 38  # first tick after the run, 0 if not known
    CLOCK_SKIPPED = 39  # number of ticks that the clock has skipped
    FOLLOWER_PID = 40  # process of the recorder for which lockstep waits, 0 for none
    FOLLOWER_TICK = 41  # everything up to this tick is recorded
    TICK_NS = 42  # CLOCK_MONOTONIC of the newest tick
    # Rises with every change in the fault table that concerns tasks. Written by the clock.
    FAULTS = 43
    DEMAND = 44  # Demand on the arm, written by the clock
    CLOCK_PID = 45
    INJECTED = 46  # grows when faults are entered into the fault table or moved in it
    LOSSES = 47  # rises by 2 for each board found dead; odd while the crate records a loss
    SYSRESET = 48
    ACFAIL = 49
    EMERGENCY_STOP = 50
    REQUESTED = 51  # number of commands entered into the operator table
    COMMANDED = 52  # serial of the newest command issued, written by the clock
    # 1 + tick before which lockstep must hold, for single steps. 0 without a hold. Written by the
    # host.
    HOLD_AT = 53
    # 1 + tick before which lockstep is holding now. 0 without a hold. Written by the clock.
    HELD = 54
    # Switch (see `encode_switch`) that is on while the arm must stop because another rack is lost.
    # Written by the network adapter.
    PEER_STOP = 55
    SKIPPED_FROM = 56  # first of the ticks that the clock skipped last
    # The recorder has taken everything up to this tick, whether or not it is in its files.
    FOLLOWER_DRAINED = 57
    # 1 + tick before which lockstep takes a snapshot, 0 for none. Written by the Rack.
    SNAPSHOT_AT = 58
    # Snapshots may take 1 / SNAPSHOT_PART of lockstep's time, 0 for no such snapshots. Written by
    # the Rack.
    SNAPSHOT_PART = 59
    # Ticks between additional periodic snapshots, 0 for none. Written by the Rack.
    SNAPSHOT_EVERY = 60
    # Number of snapshots held by the crate, of this rack or of earlier ones. Written by the crate.
    SNAPSHOTS = 61
    SNAPSHOT_BYTES = 62  # memory used by the snapshots alone, written by the crate
    EXCLUSIVE_CORES = 63  # 1 if the rack has its cores to itself, written by the Rack
    SYSFAIL = 64  # one word for each of 22 slots: 1 until the board's self-test has passed


class Run(IntEnum):
    """Values of `System.STATE`."""

    STARTING = 0
    RUNNING = 1
    STOPPED = 2


class Demand(IntEnum):
    """Values of `System.DEMAND`: the stop that the rack's safety functions require of the arm.

    If there are several, the largest value applies.
    """

    NONE = 0
    STOP = 1  # controlled stop: ramp to rest, then brake
    BRAKE = 2  # brake at once


class Block:
    """Words of a task's control block.

    The task writes them, except for RELEASED, which the clock writes, and LOST, which is written by
    the process that finds the loss. A host board has a control block too. In lockstep its bus
    adapter releases it: see `rack.boards.host.bus_adapter`.
    """

    # Newest release, as a tick; the last one of a batch. -1 before the first.
    RELEASED = 0
    DEADLINE = 1  # tick before which that cycle, or plan, must be finished
    DONE = 2  # newest release that is finished, -1 before the first
    PID = 3
    STATE = 4  # TaskState
    CYCLES = 5
    MISSED = 6
    SKIPPED = 7
    PRIORITY = 8  # SCHED_FIFO priority obtained, 0 for ordinary scheduling
    CORE = 9
    READS = 10
    READ_BYTES = 11
    WRITES = 12
    WRITE_BYTES = 13
    CORRUPT = 14  # number of messages that failed their check
    BUS_ERRORS = 15  # number of accesses that timed out
    TRACE_HEAD = 16  # number of trace records written
    LEVEL_STATE = 17  # state of the level, as in its status
    PLANS = 18  # number of plans made
    # 1 + tick at which the task was found dead or hanging, 0 if it is not lost. Cleared by the
    # clock.
    LOST = 19
    LEVEL_SINCE = 20  # tick of the cycle in which the level entered that state
    # Of the network adapter in lockstep: the rack that its cycle waits for, 0 for none. See
    # boards.lan.awaited.
    AWAITS = 21
    # Number of messages that have interrupted this board and were served (protocol interrupt).
    INTERRUPTS = 22
    INTERRUPTS_LOST = 23  # number of messages lost because too many waited
    INTERRUPTS_WAITING = 24  # largest number of messages that have waited
    CLOCK_SKIPPED = 25  # number of ticks skipped by the clock that this task has reported
    # Of a host board in lockstep: tick until which its program waits, 0 once a message has arrived.
    WAITS_UNTIL = 26
    # 1 + tick before which the task must fork a copy, 0 for none. Set by the clock.
    COPY = 27
    # Number of trace records written before this run, which continues another. Written by the
    # crate.
    TRACE_FIRST = 28
    # In lockstep, first of the releases given together with RELEASED. Written by the clock.
    FIRST = 29
    BEGUN_NS = 30  # begin of the job in `COMPUTING_NS`, in simulated ns since tick 0
    # In lockstep, tick at which a cycle that takes simulated time continues, else 0. Set by the
    # task, which then waits, and cleared by the clock.
    FINISH = 31
    SCHEDULER = 32  # Scheduler of an executor, 0 if the rack's config names none
    # In lockstep, processor time in ns of the cycle that waits for the end of its job on a
    # simulated core. Then the end of the job, in simulated ns since tick 0.
    COMPUTING_NS = 33
    # Of a task with standbys, written by the copy that takes over: see `rack.backplane.standby`.
    # Number of the active copy, 0 for the task itself.
    ACTIVE = 34
    ACTIVE_SINCE = 35  # tick from which that copy writes
    HAND_OVER = 36  # HandOver, the reason for the last hand-over
    HAND_OVERS = 37  # number of hand-overs
    # 1 + number of the copy that must take over, 0 for none; with the reason in TAKE_OVER_REASON.
    # Written by the clock and cleared by that copy.
    TAKE_OVER = 38
    TAKE_OVER_REASON = 39
    # Of each copy: 1 + tick since which its outputs equal those of the active copy, 0 while they
    # differ. Written by the copy.
    ALIGNED = 40
    # This word and the next one: vote of a copy in a cycle and in the one before or after it, see
    # `rack.boards.run.replica`. Written by the copy.
    VOTE = 41
    # Of a task with standbys: 1 + number of the copy that has strayed, 0 for none. Written by the
    # copy that has found it, and cleared by the clock.
    STRAYED = 45


class TaskState(IntEnum):
    """Values of `Block.STATE`."""

    ABSENT = 0
    STARTING = 1
    READY = 2
    RUNNING = 3
    ENDED = 4
    FAILED = 5
    GIVEN_UP = 6  # lost, and not to be restarted; written by the Rack


class HandOver(IntEnum):
    """Values of `Block.HAND_OVER`: why a copy of a task has taken over its mailboxes."""

    NONE = 0
    LOST = 1  # the process of the active copy has ended, or was found hanging
    STOPPED = 2  # a signal has stopped that process
    LATE = 3  # the active copy had not finished its cycle at its next release
    COMMANDED = 4  # an operator has switched
    STRAYED = 5  # two of three copies agree, and the active one differs


class Scheduler(IntEnum):
    """Values of `Block.SCHEDULER`: how a task competes for its core.

    On one core, tasks with a greater value precede those with a smaller one, as SCHED_DEADLINE
    precedes SCHED_FIFO.
    """

    FIXED_PRIORITY = 1
    EARLIEST_DEADLINE_FIRST = 2
    MAXIMUM_URGENCY_FIRST = 3

    @property
    def word(self) -> str:
        """Name in configs and commands, such as "fixed-priority"."""
        return self.name.lower().replace("_", "-")


SCHEDULERS = {scheduler.word: scheduler for scheduler in Scheduler}
"""Schedulers by their names in configs."""


class Box:
    """Words at the head of a mailbox."""

    HEAD = 0  # serial of the newest complete message, 0 before the first
    EPOCH = 1  # number of writers that have claimed the mailbox
    WRITER_PID = 2
    CLAIM = 3  # unused as a number: the writer holds the kernel's lock on this address
    # Address of the kernel's lock on the critical section of protocol lock. The value is the
    # process id of the owner, 0 for none.
    OWNER = 4
    # Epoch and process of the writer in one number, as in every slot that it fills. See
    # `slots.build_signature`.
    CLAIMANT = 5
    REFUSED = 6  # number of messages refused because the queue was full
    # Of a queue: serial of the newest message of the writer that holds the claim. HEAD is greater
    # after an intruder has published.
    SENT = 7
    # Of a host board's mailbox: serial of the newest message that its bus adapter has taken.
    TAKEN = 8
    # Of messages from another rack: switch (see `encode_switch`) that is on while the other rack is
    # lost. Readers then treat the writer as lost.
    VOID = 9
    # The same for a rack that continues alone: readers then use the last message, however old it
    # is.
    KEPT = 10
    # Of a queue: serial of the newest message taken, times 3. See `queue.QueueReader`.
    POSITION = 11
    FIRST = 12  # serial of the newest message before this run, see `Block.TRACE_FIRST`
    # This word and the two after it: serial of the newest message when an epoch began, of epoch e
    # in word BEGUN + e % EPOCHS. A message of an earlier epoch has no greater serial.
    BEGUN = 13
    EPOCHS = 3


class Slot:
    """Words in front of every message in its slot.

    The checksum covers the bytes from BASIS to the end of the message and, because it is seeded
    with CHAIN (the checksum of the previous message), all earlier messages. It does not cover time
    stamp and writer, so that equal runs have equal checksums.
    """

    STAMP_NS = 0
    EPOCH = 1
    CHAIN = 2
    CHECK = 3
    BASIS = 4
    SERIAL = 5
    TICK = 6
    VISIBLE_AT = 7
