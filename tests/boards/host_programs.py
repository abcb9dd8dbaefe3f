"""Programs of host boards, and levels on the real-time side, for tests of the bridge."""

from __future__ import annotations

import os
import signal
import time
from enum import IntEnum

from rack.backplane.message import Field, State, command, status
from rack.levels.host_program import Bus, HostProgram
from rack.levels.level import Executor, Input, Ports


class Colour(IntEnum):
    """An enum in a message."""

    NONE = 0
    RED = 1


NUMBER = command(
    "number",
    1,
    Field("value", "f8", "1", "a number"),
    Field("colour", "u1", Colour, "its colour"),
)
SUM = status("sum", 1, Field("sum", "f8", "1", "of all numbers read"), Field("last", "u4", "1", "newest id read"))


class Adder(Executor):
    """Adds what comes through the bridge; done once the sum has reached `goal`."""

    inputs = {"number": Input(NUMBER, "above.numbers")}
    outputs = {"status": SUM}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Add the numbers that are new, once each."""
        number, out = read.number, write.status
        for value in (*number.earlier, number.value) if number.is_new else ():
            if value.id and value.id != out.last:
                out.sum += value.value
                out.last = value.id
        is_done = out.sum >= self.context.params.get("goal", float("inf"))
        out.state = State.DONE if is_done else State.EXECUTING


class Host(HostProgram):
    """A program with both ports."""

    inputs = {"sum": Input(SUM, "below.sum")}
    outputs = {"numbers": NUMBER}


class Counting(Host):
    """Sends 1, 2, ... `count`, and waits until all are added."""

    def run(self, bus: Bus) -> None:
        """Send, wait, end."""
        count = self.context.params.get("count", 5)
        for value in range(1, count + 1):
            while not bus.send("numbers", value=value, colour=Colour.RED):
                bus.wait(1.0)
        while bus.read("sum").value.last < count and not bus.is_over:
            bus.wait(1.0)


class Flooding(Host):
    """Sends for ever, and never reads."""

    def run(self, bus: Bus) -> None:
        """Send without a pause."""
        while not bus.is_over:
            bus.send("numbers", value=1.0)


class Deaf(Host):
    """Blocks for ever in one call, and keeps out SystemExit."""

    def run(self, bus: Bus) -> None:
        """Ignore all that could end it."""
        bus.send("numbers", value=1.0)
        if os.fork() == 0:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            try:
                time.sleep(3600)
            except SystemExit:
                continue


class Improper(Host):
    """Sends what no number may hold, then a proper one."""

    def run(self, bus: Bus) -> None:
        """Send NaN, an unknown colour, then 7."""
        bus.send("numbers", value=float("nan"))
        bus.send("numbers", value=1.0, colour=9)
        bus.send("numbers", value=7.0)
        while bus.read("sum").value.sum < 7.0:
            bus.wait(1.0)


class Silent(Host):
    """Blocks for ever, without a word."""

    def run(self, bus: Bus) -> None:
        """Wait for what never comes."""
        time.sleep(3600)


class Ending(Host):
    """Is done at once."""

    def run(self, bus: Bus) -> None:
        """Do nothing."""


class Failing(Host):
    """Fails at once."""

    def run(self, bus: Bus) -> None:
        """Raise an exception of two lines."""
        raise ValueError("no\nnumbers")


class Console(Host):
    """A board for prompts."""

    def names(self, bus: Bus) -> dict[str, object]:
        """Offer a function that sends a number."""
        return {"number": lambda value: bus.send("numbers", value=value)}


class Repeater(Executor):
    """A level that reads what is for host boards."""

    inputs = {"sum": Input(SUM, "below.sum")}
    outputs = {"status": SUM}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Repeat it."""


class Listener(HostProgram):
    """A program that reads what is for levels."""

    inputs = {"numbers": Input(NUMBER, "below.numbers")}
