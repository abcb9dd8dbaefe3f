"""A program of a host board.

It has no rate, no deadline and no real-time priority. It may block, import any module, and raise
exceptions.

A host board is a separate process under ordinary scheduling. The clock does not release it, and
real time never waits for it. It reaches the levels only through a bus adapter
(`rack.boards.host.bus_adapter`), which exchanges messages at its own rate. The author writes `run`:

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

The program ends when `run` returns, or raises `RunOver` because the end of the run keeps it from
completing a call. Any other exception ends the process, which is restarted by the rack's policy
with a new object. The serials of its messages continue.

In real time messages arrive at ticks that depend on the program's timing. A replay with the
recorded entries repeats a run. In lockstep the program runs while the rack's time stands still,
until it waits in `bus.wait`. Its computing takes the simulated time `[host.x] computing_ms`. Then a
run repeats if the program depends only on its messages, `tick` and `time_s`. A program that blocks
elsewhere for 30 s ends the run. Lockstep does not wait for interactive prompts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, TypeVar

from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.message import Message
from rack.levels.errors import LevelError
from rack.levels.level import LevelContext, PortOwner
from rack.levels.ports import InputPort, M, WrittenPort

M_co = TypeVar("M_co", bound=Message, covariant=True)


class Bus(Protocol):
    """Access of a host program to the bus, in addition to its ports."""

    is_paced: bool
    """True in lockstep: time stands still except in `wait`, whose time-out is simulated time."""

    @property
    def tick(self) -> int:
        """Present tick. In lockstep, the tick of the adapter's cycle in which the program runs."""

    @property
    def time_s(self) -> float:
        """Time in s: simulated time in lockstep, CLOCK_MONOTONIC in real time."""

    @property
    def is_over(self) -> bool:
        """True when the run has ended; the program should then return."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until a message arrives.

        Returns:
            True if a message arrived. False if none arrived within `timeout_s`, measured by
            `time_s`, or if the run ended.
        """

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks of the crate."""

    def address(self, name: str) -> int:
        """Return the bus address of a mailbox, or of the control block of a task.

        Raises:
            LookupError: No mailbox or task has this name.
        """

    def words(self, address: int, count: int = 1) -> list[int]:
        """Return 8-byte words of the crate's memory, starting at a bus address.

        `rack check` prints the addresses. A program may read any word directly, without a message,
        whichever board writes it. Even in lockstep, another board may be writing it at the same
        time.

        Raises:
            ValueError: The address is not aligned to a word, or the words extend beyond the memory.
        """

    @property
    def scratch(self) -> int:
        """Bus address of the first of the 8 scratch words that the program may write."""

    def write(self, address: int, value: int) -> None:
        """Write a scratch word of the program's board: a signed 64-bit integer.

        The memory changes at once. A level must learn of it by a message, so that the change takes
        effect at a tick and is recorded.

        Raises:
            ValueError: The address is not a scratch word's, or the value is no 64-bit integer.
        """

    def finish(self) -> None:
        """Report that the program has finished its work, as returning from `run` does."""


class HostReceiver(Protocol[M_co]):
    """Connected input of a host program."""

    def read(self) -> Reading[M_co]:
        """Return the newest message.

        `Reading.earlier` contains the older unread messages that are still in the mailbox.
        """


class HostSender(Protocol[M_co]):
    """Connected output of a host program."""

    @property
    def message(self) -> M_co:
        """The next message to send.

        At first all its fields are 0, except the `id` of a command, which is the number of the
        message.
        """

    def send(self) -> bool:
        """Send a copy of the message and clear it for the next one.

        Returns:
            True if the message was sent. False if too many messages are waiting at the adapter, in
            which case the message stays unchanged.
        """

    @property
    def sent(self) -> int:
        """Number of messages sent by this process and earlier processes of this board."""


class ProgramInput(InputPort[M, HostReceiver[M]]):
    """A port that a host program reads; the attribute is a `HostReceiver`.

    Args:
        message: The class of its messages.
        source: A mailbox of a bus adapter, such as "below.motion". A config may connect another
            one.
    """


class ProgramOutput(WrittenPort[M, HostSender[M]]):
    """A port that a host program writes; the attribute is a `HostSender`.

    A bus adapter reads its mailbox, `<board>.<port>`.
    """


class HostProgram(PortOwner):
    """A program of a host board. It has no rate, so `context.every` is 1."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for port in (*cls.inputs.values(), *cls.outputs.values()):
            if not isinstance(port, ProgramInput | ProgramOutput):
                raise LevelError(
                    f"class {cls.__name__}: port '{port.name}' is a level's {type(port).__name__};"
                    " it must be a ProgramInput or ProgramOutput"
                )

    def __init__(self, context: LevelContext) -> None:
        self.context = context

    def run(self, bus: Bus) -> None:
        """Run the program. By default, wait until the run ends."""
        while not bus.is_over:
            bus.wait(1.0)

    def list_prompt_names(self, bus: Bus) -> Mapping[str, Any]:
        """Return a dictionary from names to further objects for an interactive prompt.

        The prompt also has the names `bus` and `program`.
        """
        return {}
