"""A program of the host side: no rate, no deadline, no real-time priority; it may block, import
anything, and raise.

A host board is a process of its own under ordinary scheduling. The clock does not release it; real
time never waits for it. It reaches the levels only through a bus adapter
(`rack.boards.host.bus_adapter`), which exchanges at its own rate. The author writes `run`:

    class Stroll(HostProgram):
        motion = Input(MotionStatus, "below.motion")
        requests = Output(MotionRequest)

        def run(self, bus: Bus) -> None:
            bus.send("requests", kind=MotionKind.JOINTS, joints=(0.0, -0.5, ...))
            while bus.read("motion").message.done < bus.sent("requests"):
                bus.wait(1.0)

The program is over when `run` returns. An exception ends the process, which is restarted by the
rack's policy with a new object; serials of messages go on.

In real time messages enter at ticks that depend on the program's timing; a replay with the recorded
entries repeats a run. In lockstep the program runs while the rack's time stands still, until it
waits in `bus.wait`; its computing takes the simulated time `[host.x] computing_ms`. Then a run
repeats, if the program depends on its messages, `tick` and `time_s` alone. One that blocks
elsewhere for 30 s ends the run. For prompts lockstep does not wait.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

from rack.backplane.mailbox.mailbox import Reading
from rack.levels.level import LevelContext, Program
from rack.levels.ports import InputPort, Output, collect_ports
from rack.levels.tables import Table


class Bus(Protocol):
    """The bus as a program of the host side sees it."""

    @property
    def tick(self) -> int:
        """The clock's tick; in lockstep that of the adapter's cycle in which the program runs."""

    @property
    def time_s(self) -> float:
        """Time since some moment, s: in lockstep simulated time, in real time that of
        CLOCK_MONOTONIC."""

    @property
    def is_over(self) -> bool:
        """Whether the run has ended: the program should return."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until a message arrives; False when none has after the timeout, by `time_s`, or when
        the run ends."""

    def read(self, port: str) -> Reading[Any]:
        """Return the newest message; `earlier` holds the unread ones before it, as far as the
        mailbox keeps them."""

    def send(self, port: str, **fields: Any) -> bool:
        """Send a message with these fields, all others 0; False when too many wait at the adapter.

        A command without an `id` gets the number of the message, which rises by one with every
        message sent. Raises `AttributeError` for an unknown field.
        """

    def sent(self, port: str) -> int:
        """Return the number of messages sent so far, by former processes of this board too."""

    @property
    def tasks(self) -> list[str]:
        """Names of the crate's tasks."""

    def address(self, name: str) -> int:
        """Return the bus address of a mailbox, or of the control block of a task. Raises
        `LookupError`."""

    def words(self, address: int, count: int = 1) -> list[int]:
        """Return words of 8 bytes of the crate's memory, from a bus address on; `rack check` prints
        addresses.

        Any word may be read, whoever writes it, without a message; other boards may be writing it,
        in lockstep too. Raises `ValueError` for an address that is no word's, or beyond the memory.
        """

    def finish(self) -> None:
        """Declare the program's work done, as its return does."""


class HostProgram:
    """A program of a host board. `context.every` is 1: it has no rate."""

    inputs: ClassVar[Mapping[str, InputPort[Any]]] = {}
    """Ports that it reads: mailboxes of a bus adapter, one per port, as in "below.motion"."""
    outputs: ClassVar[Mapping[str, Output[Any]]] = {}
    """Ports that it writes, each the mailbox `<board>.<port>`, for a bus adapter to read."""
    params: ClassVar[type[Table] | None] = None
    """Keys of `[host.<name>.params]`, checked before the launch; None: unchecked, the program reads
    them by itself."""
    program: ClassVar[type[Program] | None] = None
    """Keys of `[task]`, checked before the launch; None: it reads no such program."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.inputs = collect_ports(cls, "inputs", (InputPort,))
        cls.outputs = collect_ports(cls, "outputs", (Output,))

    def __init__(self, context: LevelContext) -> None:
        self.context = context

    def run(self, bus: Bus) -> None:
        """Do the program's work; by default, do nothing until the run ends."""
        while not bus.is_over:
            bus.wait(1.0)

    def names(self, bus: Bus) -> Mapping[str, Any]:
        """Return what a prompt offers by name, besides `bus` and `program`."""
        return {}
