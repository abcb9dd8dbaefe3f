"""A message by shared memory alone, and the same message by a mailbox."""

from mmap import mmap
from time import sleep

import numpy as np

from rack.backplane.message import Field, MessageType, State, status
from rack.levels.level import Executor, Input

NUMBERS = MessageType("numbers", 1, (Field("numbers", "i8", "1", "all the same", (16,)),))
COUNTS = status(
    "torn_counts",
    1,
    Field("reads", "i8", "1", "messages read"),
    Field("memory", "i8", "1", "torn messages in memory"),
    Field("mailbox", "i8", "1", "torn messages in the mailbox"),
)
READS = 1000
WORD_S = 0.0002  # a word on a slow bus
MEMORY = np.frombuffer(mmap(-1, 16 * 8), "i8")  # shared by all boards: they are forked after this


def is_torn(numbers):
    """Return whether the numbers are of more than one message."""
    return bool((numbers != numbers[0]).any())


class Writer(Executor):
    """Writes the number of its cycle 16 times."""

    outputs = {"message": NUMBERS}

    def process(self, read, write, tick):
        for place in range(16):
            MEMORY[place] = tick
            write.message.numbers[place] = tick
            sleep(WORD_S)


class Reader(Executor):
    """Counts the messages that are torn."""

    inputs = {"message": Input(NUMBERS, "writer.message")}
    outputs = {"status": COUNTS}

    def process(self, read, write, tick):
        counts = write.status
        if counts.reads == READS:
            return
        counts.reads += 1
        counts.memory += is_torn(MEMORY.copy())
        counts.mailbox += is_torn(read.message.value.numbers)
        counts.state = State.DONE if counts.reads == READS else State.EXECUTING
        counts.reason = (
            f"{counts.reads} reads: {counts.memory} torn in memory, {counts.mailbox} in the mailbox"
        )
