"""Message types: fixed numpy structured layouts, documented field by field.

A message type is declared once, with symbolic sizes ("joints"), which a rack resolves from its
config. The bytes of a resolved type travel through a mailbox.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from rack.backplane.errors import MailboxError

REASON_BYTES = 120
COMMAND_ID = "id"
"""First field of every command: its serial."""
NOT_SENT = (
    "its board writes this message in every cycle: declare the port as Output(..., queued=True) to"
    " send it"
)


class State(IntEnum):
    """State of a level, in every status message."""

    IDLE = 0
    EXECUTING = 1
    DONE = 2
    ERROR = 3
    HOLDING = 4  # has work but must wait; `reason` says for what, and what ends the wait


@dataclass(frozen=True)
class Field:
    """One field of a message: numpy scalar type, shape, unit and meaning.

    `shape` mixes integers and symbolic sizes; `kind` is a numpy type string or, for a group of
    fields, a nested `MessageType`. The unit of a number that stands for a name is its enum.
    `length`: the least and the greatest one that a vector, along its last axis, or the magnitude of
    a number may have.
    """

    name: str
    kind: str | MessageType
    unit: str | type[IntEnum]
    meaning: str
    shape: tuple[int | str, ...] = ()
    length: tuple[float, float] | None = None


@dataclass(frozen=True)
class MessageType:
    """A named, versioned layout. `fields` are ordered by offset.

    Raises `MailboxError` for a field name that a `Message` cannot have.
    """

    name: str
    version: int
    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        names = [f.name for f in self.fields]
        wrong = [n for n in names if names.count(n) > 1 or n.startswith("_") or hasattr(Message, n)]
        if wrong:
            why = "permitted: once each, no leading '_', no attribute of Message"
            raise MailboxError(f"message '{self.name}': field '{wrong[0]}': {why}")

    def dtype(self, sizes: Mapping[str, int]) -> np.dtype:
        """Return the numpy dtype with every symbolic size filled in.

        Raises `MailboxError` when `sizes` lacks one. Padding is explicit in numpy's aligned layout,
        zeroed once at creation and never written, so that equal messages have equal bytes.
        """
        return np.dtype([self._column(f, sizes) for f in self.fields], align=True)

    def _column(self, field: Field, sizes: Mapping[str, int]) -> tuple[str, Any, tuple[int, ...]]:
        kind = (
            field.kind.dtype(sizes) if isinstance(field.kind, MessageType) else np.dtype(field.kind)
        )
        missing = [s for s in field.shape if isinstance(s, str) and s not in sizes]
        if missing:
            known = ", ".join(sorted(sizes)) or "none"
            raise MailboxError(
                f"message '{self.name}' field '{field.name}': size '{missing[0]}' is unknown; known"
                f" sizes: {known}"
            )
        shape = tuple(sizes[s] if isinstance(s, str) else s for s in field.shape)
        return field.name, kind, shape


def command(name: str, version: int, *fields: Field) -> MessageType:
    """Return a command type: `fields` after the command's serial."""
    serial = Field(COMMAND_ID, "u4", "1", "serial of the command; 0: no command")
    return MessageType(name, version, (serial, *fields))


def status(
    name: str, version: int, *fields: Field, errors: str | type[IntEnum] = "1"
) -> MessageType:
    """Return a status type: `fields` after echo, state, error code, of the enum `errors` if it is
    one, and reason."""
    head = (
        Field("echo", "u4", "1", "serial of the command that this status answers"),
        Field("state", "u1", State, "idle, executing, done, error or holding"),
        Field("error", "u2", errors, "error code of the level; 0: none"),
        Field(
            "reason",
            f"S{REASON_BYTES}",
            "ASCII",
            "reason for the error or the hold, readable; empty: neither",
        ),
    )
    return MessageType(name, version, (*head, *fields))


class Message:
    """A local copy of one message: a mailbox reads into it or writes from it.

    Every field is an attribute. Array fields are numpy views of `record`: fill them in place
    (`m.position[:] = q`) or assign (`m.position = q`). Scalars read and assign as plain numbers,
    byte strings as `str`, see `text_of`. `record` is the structured array, shape (), `raw` its
    bytes.
    """

    # Slots: a misspelt field is an error, not a new attribute that is never sent.
    __slots__ = ("raw", "record")
    raw: memoryview
    record: np.ndarray

    def __new__(cls, dtype: np.dtype, buffer: memoryview | None = None) -> Message:  # noqa: D102  # as the class
        return object.__new__(_class_for(dtype))

    def __init__(self, dtype: np.dtype, buffer: memoryview | None = None) -> None:
        self.raw = memoryview(bytearray(dtype.itemsize)) if buffer is None else buffer
        self.record = np.frombuffer(self.raw, dtype=dtype, count=1).reshape(())
        for name in dtype.names or ():
            setattr(self, f"_{name}", self.record[name])

    def clear(self) -> None:
        """Set every byte to zero."""
        self.raw[:] = bytes(len(self.raw))

    def copy_from(self, other: Message) -> None:
        """Copy the bytes of a message of the same type."""
        self.raw[:] = other.raw

    def send(self, basis: int | None = None) -> bool:
        """Put a copy into the queue to which an output port leads; return False if the queue is
        full.

        Of a port that is written on demand: have the board write it in this cycle, resting on
        information of tick `basis`. Messages of other mailboxes are written in every cycle: there
        it raises `MailboxError`.
        """
        raise MailboxError(NOT_SENT)

    def room(self) -> int:
        """Return how many messages the queue still takes in this cycle; raises as `send` does."""
        raise MailboxError(NOT_SENT)

    if TYPE_CHECKING:
        # Field names come from the layout: a type checker cannot know them.
        def __setattr__(self, name: str, value: Any) -> None: ...

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"message has no field '{name}'; fields: {', '.join(self.record.dtype.names or ())}"
        )

    def __repr__(self) -> str:
        return f"Message({ {n: self.record[n].tolist() for n in self.record.dtype.names or ()} })"


def text_of(content: bytes | bytearray) -> str:
    """Return the content of a text field for people: see `printable`."""
    return printable(content.decode("ascii", "replace"))


def printable(text: str) -> str:
    """Return a text with control characters as escapes.

    Texts come from other racks and from levels of users, and end on terminals, which would obey an
    escape sequence.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def reason_of(status: Message) -> str:
    """Return the reason in a level's status; empty for a status of a user's level without one."""
    return str(getattr(status, "reason", ""))


def state_name(state: int | None, otherwise: str = "") -> str:
    """Return the name of a level's state; of a user's level that has others, `otherwise` or the
    number."""
    return State(state).name.lower() if state in set(State) else otherwise or str(state)


def copied(message: Message) -> Message:
    """Return a copy of a message, in memory of its own."""
    copy = Message(message.record.dtype)
    copy.copy_from(message)
    return copy


def fill_counts(record: Any, counts: Iterable[float]) -> None:
    """Fill the fields of a record; an integer stays at the greatest that its field holds, whoever
    drives it."""
    kinds = (kind for kind, *_ in record.dtype.fields.values())
    record[...] = tuple(
        min(count, _greatest(kind)) for count, kind in zip(counts, kinds, strict=True)
    )


@cache
def _greatest(kind: np.dtype) -> float:
    return np.iinfo(kind).max if kind.kind in "iu" else np.inf


@cache
def _class_for(dtype: np.dtype) -> type[Message]:
    """Return the subclass of `Message` with one property per field, made once per dtype."""
    names = dtype.names or ()
    properties = {name: _property(f"_{name}", dtype[name]) for name in names}
    slots = tuple(f"_{name}" for name in names)
    return type("Message", (Message,), {"__slots__": slots, **properties})


def _property(slot: str, dtype: np.dtype) -> property:
    view = attrgetter(slot)

    def store(self: Message, value: Any) -> None:
        view(self)[...] = value

    if dtype.shape or dtype.names:
        return property(view, store)
    if dtype.kind == "S":
        size = dtype.itemsize

        def store_text(self: Message, value: str | bytes) -> None:
            data = value.encode("ascii", "replace") if isinstance(value, str) else value
            view(self)[...] = data[:size]

        return property(lambda self: text_of(view(self).item()), store_text)
    return property(lambda self: view(self).item(), store)


def sending(plain: Message, send: Callable[..., bool], room: Callable[[], int]) -> Message:
    """Return a message on the bytes of `plain` that has these methods `send` and `room`."""
    kind = type("Message", (type(plain),), {"__slots__": ("room", "send")})
    message: Message = object.__new__(kind)
    message.__init__(plain.record.dtype, plain.raw)  # type: ignore[misc]
    # Their slots hide the methods of `Message`.
    setattr(message, "send", send)  # noqa: B010
    setattr(message, "room", room)  # noqa: B010
    return message
