"""Ports of a level, declared as attributes of its class: what it reads and what it writes.

```python
class PowerMeter(Executor):
    servo = Input(ServoStatus, "servo.status")
    status = Output(PowerStatus)

    def process(self, tick: int) -> None:
        servo = self.servo.message
        self.status.power = float((servo.torque * servo.velocity).sum())
```

The class attribute is the declaration. In an object the attribute is what the board puts there in
every cycle: a `Reading` of an input, the message of an output.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, Self, TypeVar, overload

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.levels.errors import LevelError

M = TypeVar("M", bound=Message)


class Port(Generic[M]):
    """A port of a level, by its name in the class."""

    message: type[M]
    name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def not_connected(self) -> LevelError:
        """Return the error of an object that uses the port before a board has connected it."""
        return LevelError(f"port '{self.name}': no board has connected it to a mailbox")


class InputPort(Port[M]):
    """A port that a level reads.

    Attributes:
        source: The mailbox, or mailboxes, as of `Input`.
        many: Whether it reads the mailbox of every neighbour.
        optional: Whether the level also works without any.
    """

    many = False
    optional = False

    def __init__(self, message: type[M], source: str) -> None:
        self.message = message
        self.source = source


class Input(InputPort[M]):
    """A port that a level reads: an attribute that is a `Reading` of a message class.

    Args:
        message: The class of its messages.
        source: A mailbox ("world.model"), or relative to the level: "above.command",
            "below.status", "own.plan". A config may wire the port elsewhere.
    """

    @overload
    def __get__(self, level: None, owner: type) -> Self: ...
    @overload
    def __get__(self, level: Any, owner: type) -> Reading[M]: ...
    def __get__(self, level: Any, owner: type) -> Self | Reading[M]:
        """Return the declaration or, of a level that no board has connected, an empty reading."""
        if level is None:
            return self
        empty = Reading(self.message.zeros(level.context.sizes), Verdict.NONE)
        return vars(level).setdefault(self.name, empty)  # type: ignore[no-any-return]


class Inputs(InputPort[M]):
    """A port that reads the mailbox of every neighbour: an attribute that maps boards to readings.

    In the config's order. By mailbox where the config names several of one board.

    Args:
        message: The class of all messages.
        source: As of `Input`.
        optional: The level also works without any such neighbour.
    """

    many = True

    def __init__(self, message: type[M], source: str, *, optional: bool = False) -> None:
        super().__init__(message, source)
        self.optional = optional

    @overload
    def __get__(self, level: None, owner: type) -> Self: ...
    @overload
    def __get__(self, level: Any, owner: type) -> Mapping[str, Reading[M]]: ...
    def __get__(self, level: Any, owner: type) -> Self | Mapping[str, Reading[M]]:
        """Return the declaration or, of a level that no board has connected, no readings."""
        return self if level is None else vars(level).setdefault(self.name, {})


class Output(Port[M]):
    """A port that a level writes: an attribute that is a message, written at the end of each cycle.

    Fields keep their values from cycle to cycle.

    Args:
        message: The class of its messages.
        cycles: Written in every n-th cycle: the last one before a multiple of n cycles' ticks,
            counted from the board's phase, so that readers released then find it fresh. If that
            cycle is missed, the message is missing too.
        rests_on: The input whose information it passes on. Its messages carry the tick of that
            information, the oldest one of an `Inputs`. By default they carry the tick of their own
            release. The response of the whole hierarchy is measured by these ticks.
    """

    queued = False
    max_age_s = 0.0

    def __init__(
        self,
        message: type[M],
        *,
        cycles: int = 1,
        rests_on: InputPort[Any] | None = None,
    ) -> None:
        self.message = message
        self.cycles = cycles
        self.rests_on = rests_on

    @overload
    def __get__(self, level: None, owner: type) -> Self: ...
    @overload
    def __get__(self, level: Any, owner: type) -> M: ...
    def __get__(self, level: Any, owner: type) -> Self | M:
        """Return the declaration or, of a level that no board has connected, a message."""
        if level is None:
            return self
        message = self.message.zeros(level.context.sizes)
        return vars(level).setdefault(self.name, message)  # type: ignore[no-any-return]

    def is_due(self, tick: int, every: int, phase: int) -> bool:
        """Return whether the cycle released at `tick`, every `every` ticks from tick `phase`,
        writes it.
        """
        return (tick - phase + every) % (self.cycles * every) == 0


class Sender(Generic[M]):
    """A message and the way to send it, of a port that is not simply written in every cycle.

    Attributes:
        message: What is sent; the level fills it.
        send: Sends a copy of it; False: the queue is full, and the message was not taken. Takes the
            tick of the information on which the message rests, if that is not the port's own.
        room: Returns how many messages may still be sent in this cycle.
    """

    # A field that is set here in place of in the message is an error.
    __slots__ = ("message", "room", "send")

    def __init__(self, message: M, send: Callable[..., bool], room: Callable[[], int]) -> None:
        self.message = message
        self.send = send
        self.room = room


class SentOutput(Output[M]):
    """A port whose messages the level sends itself: an attribute that is a `Sender`."""

    @overload  # type: ignore[override]
    def __get__(self, level: None, owner: type) -> Self: ...
    @overload
    def __get__(self, level: Any, owner: type) -> Sender[M]: ...
    def __get__(self, level: Any, owner: type) -> Self | Sender[M]:
        """Return the declaration; a level that no board has connected can send nothing."""
        if level is None:
            return self
        raise self.not_connected()


class QueuedOutput(SentOutput[M]):
    """A port whose messages go through a queue, any number in a cycle: none is missed."""

    queued = True


class TimedOutput(SentOutput[M]):
    """A port that is written only in cycles in which the level sends its message.

    Args:
        message: The class of its messages.
        max_age_s: Age of the information from which readers find its writer lost, s of simulated
            time; in between they find the message old.
    """

    def __init__(self, message: type[M], max_age_s: float) -> None:
        super().__init__(message)
        self.max_age_s = max_age_s


class MadePorts(NamedTuple):
    """Ports that a config makes, in addition to those that a class declares; not `is_whole` if some
    are unknown.
    """

    inputs: Mapping[str, InputPort[Any]] = MappingProxyType({})
    outputs: Mapping[str, Output[Any]] = MappingProxyType({})
    is_whole: bool = True


class FindingKind:
    """What a level may find and report, declared as an attribute of its class: an event of a run.

    ```python
    contact = FindingKind(unit="N m", doc="the arm touches something")
    ```

    Args:
        unit: Unit of the value measured; "1" for a plain number.
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
        """What is wrong with the declaration; empty: nothing."""
        if not self.unit or not self.doc:
            return 'needs a unit ("1": a plain number) and a meaning, doc="..."'
        if self.name.upper() in RESERVED:
            return "has the name of another kind of event; rename it"
        return ""


RESERVED = frozenset((*Alarm.__members__, "BEGINS", "ENDS", "DIED", "RESTART"))
"""Names that no finding may have: those of alarms, and of what befalls boards and faults."""


def collect_ports(level: type, attribute: str, kinds: tuple[type, ...]) -> dict[str, Any]:
    """Return the ports, or findings, of a class: those of its bases, then its own.

    A class drops one of a base by setting it to None.

    Args:
        level: The class.
        attribute: The attribute in which the bases have theirs, by name.
        kinds: Classes to collect.

    Raises:
        LevelError: The class has a port and another attribute of the same name, or lists its ports
            in a dict, as before version 0.3.
    """
    if attribute in vars(level):
        why = f"'{attribute}' is not a dict any more: each port is an attribute of the class"
        raise LevelError(f"class {level.__name__}: {why}, as in status = Output(MyStatus)")
    noun = "finding" if FindingKind in kinds else "port"
    known: dict[str, Any] = {}
    for base in reversed(level.__mro__[1:]):
        known |= {port.name: port for port in vars(base).get(attribute, {}).values()}
    found = dict(known)
    for name, value in vars(level).items():
        if isinstance(value, kinds):
            if name not in known and any(hasattr(base, name) for base in level.__bases__):
                why = f"{noun} '{name}' has the name of another attribute"
                raise LevelError(f"class {level.__name__}: {why}; rename the {noun}")
            # A port declared again takes its place among the class's own.
            found.pop(name, None)
            found[name] = value
        elif name in known and value is None:
            del found[name]
        elif name in known:
            why = f"attribute '{name}' has the name of a {noun}"
            raise LevelError(f"class {level.__name__}: {why}; rename the attribute")
    return found
