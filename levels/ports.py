"""Ports of a level, declared as attributes of its class: what it reads and what it writes.

```python
class PowerMeter(Executor):
    servo = Input(ServoStatus, "servo.status")
    status = Output(PowerStatus)

    def process(self, tick: int) -> None:
        servo = self.servo.message
        self.status.power = float((servo.torque * servo.velocity).sum())
```

The class attribute is the declaration. In an object, the board sets the attribute in every cycle:
to a `Reading` for an input, to the message for an output.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, Self, TypeVar, overload

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.levels.errors import LevelError

M = TypeVar("M", bound=Message)
V = TypeVar("V")


class Port(Generic[M, V]):
    """A port of a level, named after its attribute in the class."""

    message: type[M]
    name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, level: None, owner: type) -> Self: ...
    @overload
    def __get__(self, level: Any, owner: type) -> V: ...
    def __get__(self, level: Any, owner: type) -> Self | V:
        """Return the declaration, or the value of a port that no board has connected."""
        if level is None:
            return self
        return vars(level).setdefault(self.name, self.build_unconnected(level))  # type: ignore[no-any-return]

    def build_unconnected(self, level: Any) -> V:
        """Return the value of the port before a board has connected it.

        Raises `LevelError` for a port that needs a board.
        """
        raise LevelError(f"port '{self.name}': no board has connected it to a mailbox")


class InputPort(Port[M, V]):
    """A port that a level reads.

    Attributes:
        source: The mailbox or mailboxes, see `Input`.
        many: True if the port reads the mailbox of every neighbour.
        optional: True if the level also works without any such neighbour.
    """

    many = False
    optional = False

    def __init__(self, message: type[M], source: str) -> None:
        self.message = message
        self.source = source


class Input(InputPort[M, Reading[M]]):
    """A port that a level reads; the attribute is a `Reading` of a message class.

    Args:
        message: The class of its messages.
        source: A mailbox ("world.model"), or a place relative to the level: "above.command",
            "below.status", "own.plan". A config may connect another mailbox.
    """

    def build_unconnected(self, level: Any) -> Reading[M]:
        """Return an empty reading."""
        return Reading(self.message.zeros(level.context.sizes), Verdict.NONE)


class Inputs(InputPort[M, Mapping[str, Reading[M]]]):
    """A port that reads the mailbox of every neighbour; the attribute maps boards to readings.

    The boards are in the order of the config. If the config names several mailboxes of one board,
    the keys are mailboxes.

    Args:
        message: The class of all messages.
        source: As in `Input`.
        optional: True if the level also works without any such neighbour.
    """

    many = True

    def __init__(self, message: type[M], source: str, *, optional: bool = False) -> None:
        super().__init__(message, source)
        self.optional = optional

    def build_unconnected(self, level: Any) -> Mapping[str, Reading[M]]:
        """Return no readings."""
        return {}


class WrittenPort(Port[M, V]):
    """A port that a level writes.

    Args:
        message: The class of its messages.
        cycles: Write the message in every n-th cycle: the last cycle of each group of n, counted
            from the board's phase. Readers that are released at the start of the next group
            therefore read a fresh message. If that cycle is missed, no message is written.
        rests_on: The input on whose information the messages are based. A message carries the tick
            of that information, or of the oldest information of an `Inputs`. By default it carries
            the tick of the cycle's release. The response of the whole hierarchy is measured by
            these ticks.
    """

    queued = False
    max_age_s = 0.0

    def __init__(
        self,
        message: type[M],
        *,
        cycles: int = 1,
        rests_on: InputPort[Any, Any] | None = None,
    ) -> None:
        self.message = message
        self.cycles = cycles
        self.rests_on = rests_on

    def is_due(self, tick: int, every: int, phase: int) -> bool:
        """Return True if the cycle released at `tick` writes the port.

        Args:
            tick: Tick of the cycle's release.
            every: Length of a cycle, ticks.
            phase: First tick of the level.
        """
        return (tick - phase + every) % (self.cycles * every) == 0


class Output(WrittenPort[M, M]):
    """A port that a level writes; the attribute is a message, written at the end of each cycle.

    Fields keep their values from cycle to cycle. See `WrittenPort` for the arguments.
    """

    def build_unconnected(self, level: Any) -> M:
        """Return an empty message."""
        return self.message.zeros(level.context.sizes)


@dataclass(slots=True)
class Sender(Generic[M]):
    """A message and the function to send it, for a port that is not written in every cycle.

    Attributes:
        message: The message to fill.
        send: Sends a copy of the message. Returns False if the message was not sent because the
            queue is full. Its optional argument is the tick of the information on which the message
            is based.
        room: Returns how many more messages can be sent in this cycle.

    Slots make it an error to set a field here instead of in the message.
    """

    message: M
    send: Callable[..., bool]
    room: Callable[[], int]


class QueuedOutput(WrittenPort[M, Sender[M]]):
    """A port that sends any number of messages in a cycle through a queue, so none is missed.

    The attribute is a `Sender`.
    """

    queued = True


class TimedOutput(WrittenPort[M, Sender[M]]):
    """A port that is written only in the cycles in which the level sends its message.

    The attribute is a `Sender`.

    Args:
        message: The class of its messages.
        max_age_s: Age of the information, in s of simulated time, from which readers consider the
            writer lost. Until then they read the message as old.
    """

    def __init__(self, message: type[M], max_age_s: float) -> None:
        super().__init__(message)
        self.max_age_s = max_age_s


class ConfiguredPorts(NamedTuple):
    """Ports that a config creates, in addition to the ports that a class declares.

    `is_complete` is False if the parameters are invalid, so that some ports are unknown.
    """

    inputs: Mapping[str, InputPort[Any, Any]] = MappingProxyType({})
    outputs: Mapping[str, WrittenPort[Any, Any]] = MappingProxyType({})
    is_complete: bool = True


class FindingKind:
    """A kind of finding that a level may raise, declared as an attribute of its class.

    Each episode of a finding is an event of the run.

    ```python
    contact = FindingKind(unit="N m", doc="the arm touches something")
    ```

    Args:
        unit: Unit of the measured value. "1" for a plain number.
        doc: Meaning, in a few words.
    """

    name = ""

    def __init__(self, *, unit: str, doc: str) -> None:
        self.unit = unit
        self.doc = doc

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @property
    def mistake(self) -> str:
        """Description of the mistake in the declaration, or an empty string if it is valid."""
        if not self.unit or not self.doc:
            return 'needs a unit ("1": a plain number) and a meaning, doc="..."'
        if self.name.upper() in RESERVED_NAMES:
            return "has the name of another kind of event; rename it"
        return ""


RESERVED_NAMES = frozenset((*Alarm.__members__, "BEGINS", "ENDS", "DIED", "RESTART"))
"""Names that no finding may have: alarms, and events of boards and faults."""


def collect_ports(level: type, attribute: str, kind: type) -> dict[str, Any]:
    """Return the ports or findings of a class, keyed by name: inherited ones, then its own.

    A class removes an inherited port or finding by setting the attribute to None.

    Args:
        level: The class.
        attribute: Name of the class attribute that lists the ports of each base class.
        kind: Class of the ports to collect.

    Raises:
        LevelError: The class has a port and another attribute of the same name, or lists its ports
            in a dict, as before version 0.3.
    """
    if attribute in vars(level):
        raise LevelError(
            f"class {level.__name__}: '{attribute}' is no longer a dict: each port is an attribute"
            " of the class, as in status = Output(MyStatus)"
        )
    noun = "finding" if kind is FindingKind else "port"
    known: dict[str, Any] = {}
    for base in reversed(level.__mro__[1:]):
        known |= {port.name: port for port in vars(base).get(attribute, {}).values()}
    ports = dict(known)
    for name, value in vars(level).items():
        if isinstance(value, kind):
            if name not in known and any(hasattr(base, name) for base in level.__bases__):
                raise LevelError(
                    f"class {level.__name__}: {noun} '{name}' has the name of another attribute;"
                    f" rename the {noun}"
                )
            # A port that is declared again moves to the class's own ports.
            ports.pop(name, None)
            ports[name] = value
        elif name in known and value is None:
            del ports[name]
        elif name in known:
            raise LevelError(
                f"class {level.__name__}: attribute '{name}' has the name of a {noun}; rename the"
                " attribute"
            )
    return ports
