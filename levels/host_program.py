"""A program of the host side: no rate, no deadline, no real-time priority; it may block, import
anything, and raise.

A host board is a process of its own under ordinary scheduling. The clock does not release it; real
time never waits for it. It reaches the levels only through a bus adapter
(`rack.boards.host.bus_adapter`), which exchanges at its own rate. The author writes `run`:

    class Stroll(HostProgram):
        motion = ProgramInput(MotionStatus, "below.motion")
        requests = ProgramOutput(MotionRequest)

        def run(self, bus: Bus) -> None:
            request = self.requests.message
            request.kind = MotionKind.JOINTS
            request.joints[:] = (0.0, -0.5, ...)
            self.requests.send()
            while self.motion.read().message.done < self.requests.sent:
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
from typing import Any, ClassVar, Protocol, Self, TypeVar, overload

from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.message import Message
from rack.levels.errors import LevelError
from rack.levels.level import LevelContext, Program
from rack.levels.ports import InputPort, M, Output, collect_ports
from rack.levels.tables import Table

M_co = TypeVar("M_co", bound=Message, covariant=True)


class Bus(Protocol):
    """The bus as a program of the host side sees it."""

    @property
    def tick(self) -> int:
        """The clock's tick; in lockstep that of the adapter's cycle in which the program runs."""

    @property
    def time_s(self) -> float:
        """Time since some moment, s: in lockstep simulated time, in real time that of
        CLOCK_MONOTONIC.
        """

    @property
    def is_over(self) -> bool:
        """Whether the run has ended: the program should return."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until a message arrives; False when none has after the timeout, by `time_s`, or when
        the run ends.
        """

    @property
    def tasks(self) -> list[str]:
        """Names of the crate's tasks."""

    def address(self, name: str) -> int:
        """Return the bus address of a mailbox, or of the control block of a task. Raises
        `LookupError`.
        """

    def words(self, address: int, count: int = 1) -> list[int]:
        """Return words of 8 bytes of the crate's memory, from a bus address on; `rack check` prints
        addresses.

        Any word may be read, whoever writes it, without a message; other boards may be writing it,
        in lockstep too. Raises `ValueError` for an address that is no word's, or beyond the memory.
        """

    def finish(self) -> None:
        """Declare the program's work done, as its return does."""


class HostReceiver(Protocol[M_co]):
    """An input of a host program at work."""

    def read(self) -> Reading[M_co]:
        """Return the newest message; `earlier` holds the unread ones before it, as far as the
        mailbox keeps them.
        """


class HostSender(Protocol[M_co]):
    """An output of a host program at work."""

    @property
    def message(self) -> M_co:
        """The next message: all its fields are 0, but for the `id` of a command, which is the
        number of the message.
        """

    def send(self) -> bool:
        """Send a copy of the message, and begin the next one; return False, and leave it as it is,
        when too many wait at the adapter.
        """

    @property
    def sent(self) -> int:
        """Number of messages sent so far, by former processes of this board too."""


class ProgramInput(InputPort[M]):
    """A port that a host program reads: an attribute that is a `HostReceiver`.

    Args:
        message: The class of its messages.
        source: A mailbox of a bus adapter, as in "below.motion". A config may wire it elsewhere.
    """

    @overload
    def __get__(self, program: None, owner: type) -> Self: ...
    @overload
    def __get__(self, program: Any, owner: type) -> HostReceiver[M]: ...
    def __get__(self, program: Any, owner: type) -> Self | HostReceiver[M]:
        """Return the declaration; a program that no board has connected can read nothing."""
        if program is None:
            return self
        raise self.not_connected()


class ProgramOutput(Output[M]):
    """A port that a host program writes, the mailbox `<board>.<port>`, for a bus adapter to read:
    an attribute that is a `HostSender`.
    """

    def __init__(self, message: type[M]) -> None:
        super().__init__(message)

    @overload  # type: ignore[override]
    def __get__(self, program: None, owner: type) -> Self: ...
    @overload
    def __get__(self, program: Any, owner: type) -> HostSender[M]: ...
    def __get__(self, program: Any, owner: type) -> Self | HostSender[M]:
        """Return the declaration; a program that no board has connected can send nothing."""
        if program is None:
            return self
        raise self.not_connected()


class HostProgram:
    """A program of a host board. `context.every` is 1: it has no rate."""

    inputs: ClassVar[Mapping[str, ProgramInput[Any]]] = {}
    """The ports that it reads, by name: collected from the class and its bases."""
    outputs: ClassVar[Mapping[str, ProgramOutput[Any]]] = {}
    """The ports that it writes, likewise."""
    params: ClassVar[type[Table] | None] = None
    """Keys of `[host.<name>.params]`, checked before the launch; None: unchecked, the program reads
    them by itself."""
    program: ClassVar[type[Program] | None] = None
    """Keys of `[task]`, checked before the launch; None: it reads no such program."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.inputs = collect_ports(cls, "inputs", (InputPort,))
        cls.outputs = collect_ports(cls, "outputs", (Output,))
        for port in (*cls.inputs.values(), *cls.outputs.values()):
            if not isinstance(port, ProgramInput | ProgramOutput):
                why = f"port '{port.name}' is a level's {type(port).__name__}"
                raise LevelError(
                    f"class {cls.__name__}: {why}; permitted: ProgramInput, ProgramOutput"
                )

    def __init__(self, context: LevelContext) -> None:
        self.context = context

    def run(self, bus: Bus) -> None:
        """Do the program's work; by default, do nothing until the run ends."""
        while not bus.is_over:
            bus.wait(1.0)

    def names(self, bus: Bus) -> Mapping[str, Any]:
        """Return what a prompt offers by name, besides `bus` and `program`."""
        return {}
