"""Programs of host boards, and levels on the real-time side, for tests of the bridge."""

from __future__ import annotations

import os
import random
import signal
import time
from enum import IntEnum

from rack.backplane.message import Command, State, Status, field
from rack.backplane.segment import Segment
from rack.boards.host import bus_adapter
from rack.boards.host.bus_adapter import BusAdapter
from rack.boards.wiring import RecordedEntries
from rack.levels.errors import RunOver
from rack.levels.host_program import Bus, HostProgram, ProgramInput, ProgramOutput
from rack.levels.level import Executor, Input, Output


class Colour(IntEnum):
    """An enum in a message."""

    NONE = 0
    RED = 1


class Number(Command, version=1):
    value: float = field(unit="1", doc="a number")
    colour: Colour = field(doc="its colour")


class Sum(Status, version=1):
    sum: float = field(unit="1", doc="of all numbers read")
    last: int = field("u4", unit="1", doc="newest id read")


class Adder(Executor):
    """Adds what comes through the bridge."""

    number = Input(Number, "above.numbers")
    status = Output(Sum)

    def process(self, tick: int) -> None:
        """Add the numbers that are new, once each."""
        number, out = self.number, self.status
        for value in (*number.earlier, number.message) if number.is_new else ():
            if value.id and value.id != out.last:
                out.sum += value.value
                out.last = value.id
        out.state = State.EXECUTING


class Host(HostProgram):
    """A program with both ports."""

    sum = ProgramInput(Sum, "below.sum")
    numbers = ProgramOutput(Number)

    def send_number(self, value: float, colour: Colour = Colour.NONE) -> bool:
        """Send a number; False if too many wait."""
        self.numbers.message.value = value
        self.numbers.message.colour = colour
        return self.numbers.send()


class Counting(Host):
    """Sends 1, 2, ... `count`, and waits until all are added."""

    def run(self, bus: Bus) -> None:
        count = self.context.params.get("count", 5)
        for value in range(1, count + 1):
            while not self.send_number(value, Colour.RED):
                bus.wait(1.0)
        while self.sum.read().message.last < count and not bus.is_over:
            bus.wait(1.0)


class Deaf(Host):
    """Blocks for ever in one call, and keeps out SystemExit."""

    def run(self, bus: Bus) -> None:
        self.send_number(1.0)
        if os.fork() == 0:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            try:
                time.sleep(3600)
            except SystemExit:
                continue


class Escaping(Host):
    """Leaves a daemon behind, in a session of its own, which keeps SIGTERM out."""

    def run(self, bus: Bus) -> None:
        """Fork twice, and wait; the daemon prints its id."""
        child = os.fork()
        if child == 0:
            if os.fork() == 0:
                os.setsid()
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                os.write(1, f"daemon {os.getpid()}\n".encode())
                time.sleep(60)
            os._exit(0)
        os.waitpid(child, 0)
        super().run(bus)


class Persistent(Host):
    """Sends numbers, until the end of the run refuses one."""

    def run(self, bus: Bus) -> None:
        while not bus.is_over:
            self.send_number(1.0)
            bus.wait(1.0)
        raise RunOver("the run is over")


class Silent(Host):
    """Blocks for ever, without a word."""

    def run(self, bus: Bus) -> None:
        time.sleep(3600)


class Waiting(Host):
    """Sends one number, and waits."""

    def run(self, bus: Bus) -> None:
        self.send_number(1.0)
        super().run(bus)


class Slow(Host):
    """Sends 40 numbers that hold what it sees, and computes up to `lag` seconds for each."""

    again = ProgramInput(Sum, "second.sum")

    def run(self, bus: Bus) -> None:
        """Compute, send, wait; end once all were added."""
        while self.numbers.sent < 40:
            time.sleep(random.uniform(0.0, self.context.params["lag"]))
            seen = self.sum.read().message.sum + self.again.read().message.last
            self.send_number(seen % 7.0 + bus.time_s + bus.tick)
            bus.wait(0.03)
        while self.sum.read().message.last < self.numbers.sent and not bus.is_over:
            bus.wait(1.0)


class Lingering(Host):
    """Is done at once, and stays."""

    def run(self, bus: Bus) -> None:
        """Declare the work done; end with the rack."""
        bus.finish()
        time.sleep(3600)


class HastyAdapter(BusAdapter):
    """A bus adapter that waits for a program for a second at most."""

    def attach_segment(self, segment: Segment, entries: RecordedEntries | None) -> None:
        bus_adapter.LONGEST_S = 1.0
        super().attach_segment(segment, entries)


class Ending(Host):
    """Is done at once."""

    def run(self, bus: Bus) -> None:
        """Do nothing."""


class Failing(Host):
    """Fails at once."""

    def run(self, bus: Bus) -> None:
        raise ValueError("no\nnumbers")


class Console(Host):
    """A board for prompts."""

    def list_prompt_names(self, bus: Bus) -> dict[str, object]:
        """Offer a function that sends a number."""
        return {"number": self.send_number}


class Repeater(Executor):
    """A level that reads what is for host boards."""

    sum = Input(Sum, "below.sum")
    status = Output(Sum)

    def process(self, tick: int) -> None:
        """Repeat it."""


class Listener(HostProgram):
    """A program that reads what is for levels."""

    numbers = ProgramInput(Number, "below.numbers")
