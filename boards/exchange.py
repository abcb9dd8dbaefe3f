"""The exchange record of a board: the age and the arrival of the message in use at each input port.

The message in use is the last one that the board has read. Its arrival is the cycle that read it
first. A board whose config has tables `[board.<name>.exchange.<port>]` writes the record into its
mailbox `<name>.exchange` in every cycle, so that ages and arrivals are recorded like any other
message.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import AnyMessage, Message, field, make_message
from rack.backplane.watch.watched_reader import GridReader, MailboxWatcher

if TYPE_CHECKING:
    # A tool that inspects a running rack must not import the levels.
    from rack.boards.wiring import Source

EXCHANGE_PORT = "exchange"
"""Name of the port for the exchange record, and of its message type."""
AGE_SUFFIX = "age"
TAKEN_SUFFIX = "taken"
"""Suffix of the names of fields with arrivals. Fields with ages have `AGE_SUFFIX`."""
_NEW = Verdict.NEW  # for the hot path
NEVER = -1
"""Arrival tick of an input at which no message has arrived."""


def build_exchange_message(reads: Mapping[str, Source]) -> type[Message]:
    """Create the message class of a board's exchange record.

    Args:
        reads: Source of each input port. The message has two fields for each mailbox: age and
            arrival.
    """
    age = (
        "from the release of the message in use to that of this cycle; negative: released later; 0"
        " before the first"
    )
    taken = f"release of the cycle that took it; {NEVER} before the first"
    fields: dict[str, Any] = {}
    for port, source in reads.items():
        labels = [port] if isinstance(source, str) else [f"{port}_{board}" for board in source]
        for label in labels:
            fields[f"{label}_{AGE_SUFFIX}"] = field(unit="tick", doc=age)
            fields[f"{label}_{TAKEN_SUFFIX}"] = field(unit="tick", doc=taken)
    return make_message(EXCHANGE_PORT, Message, fields)


@dataclass(frozen=True)
class PortAge:
    """Age of the message in use at an input, in ticks, and the tick at which it arrived."""

    age: int
    taken: int


def list_port_ages(exchange: Message) -> dict[str, PortAge]:
    """Return the age and the arrival of the message in use at each input.

    Inputs at which no message has arrived are left out.

    Args:
        exchange: Exchange record of a board.

    Returns:
        A dictionary from input to age and arrival. The key is the port, or "<port>_<board>" for a
            port with several mailboxes.
    """
    names = (exchange.record.dtype.names or ())[::2]
    values = iter(exchange.raw.cast("q"))
    return {
        name.removesuffix(f"_{AGE_SUFFIX}"): PortAge(age, taken)
        for name, age, taken in zip(names, values, values, strict=True)
        if taken != NEVER
    }


class InputMailbox(NamedTuple):
    """One mailbox to read.

    Attributes:
        readings: Table that receives the reading.
        key: Key of the reading in that table.
        watcher: Reads the mailbox and checks its messages.
    """

    readings: dict[str, Reading[AnyMessage]]
    key: str
    watcher: MailboxWatcher | GridReader


class ExchangeRecord:
    """Fills a board's exchange record from its inputs.

    The inputs must be in the order of the ports passed to `build_exchange_message`.
    """

    def __init__(self, inputs: Sequence[InputMailbox], message: Message) -> None:
        self._inputs = tuple(inputs)
        # Age and arrival of each input alternate.
        self._values = message.raw.cast("q")
        for at in range(len(self._inputs)):
            self._values[2 * at + 1] = NEVER

    def fill_message(self, tick: int) -> None:
        """Update ages and arrivals. Call this after the reads of the cycle released at `tick`."""
        values = self._values
        at = 0
        for readings, key, watcher in self._inputs:
            reader = watcher.reader
            if readings[key].verdict is _NEW:
                values[at + 1] = tick
            values[at] = tick - reader.newest if reader.serial else 0
            at += 2
