"""The same message through plain shared memory and through a mailbox."""

from mmap import mmap
from time import sleep

import numpy as np

from rack.backplane.message import Message, State, Status, field
from rack.levels.level import Executor, Input, Output


class Numbers(Message, version=1):
    """Sixteen equal numbers, so that a reader can detect a torn message."""

    numbers: np.ndarray = field("i8", unit="1", doc="equal numbers", shape=16)


class TornCounts(Status, version=1):
    """Number of torn messages that a reader found."""

    reads: int = field(unit="1", doc="messages read")
    memory: int = field(unit="1", doc="torn messages in memory")
    mailbox: int = field(unit="1", doc="torn messages in the mailbox")


READS = 1000
WORD_S = 0.0002  # time to write a word over a slow bus
MEMORY = np.frombuffer(mmap(-1, 16 * 8), "i8")  # shared by all boards: they are forked after this


def is_torn(numbers):
    """Return whether the numbers belong to more than one message."""
    return bool((numbers != numbers[0]).any())


class Writer(Executor):
    """Writes the current tick 16 times."""

    message = Output(Numbers)

    def process(self, tick):
        for place in range(16):
            MEMORY[place] = tick
            self.message.numbers[place] = tick
            sleep(WORD_S)


class Reader(Executor):
    """Counts the messages that are torn."""

    message = Input(Numbers, "writer.message")
    status = Output(TornCounts)

    def process(self, tick):
        counts = self.status
        if counts.reads == READS:
            return
        counts.reads += 1
        counts.memory += is_torn(MEMORY.copy())
        counts.mailbox += is_torn(self.message.message.numbers)
        counts.state = State.DONE if counts.reads == READS else State.EXECUTING
        counts.reason = (
            f"{counts.reads} reads: {counts.memory} torn in memory, {counts.mailbox} in the mailbox"
        )
