"""Messages are classes: a local copy of one message has every field as an attribute.

```python
class PowerStatus(Status, version=1):
    \"\"\"Power drawn by the arm.\"\"\"

    power: float = field(unit="W", doc="mechanical power")
    torque: np.ndarray = field(unit="N m", doc="applied torque", shape="joints")
```

A scalar is a `float`, an `int`, a `bool`, a `str` or a member of an `IntEnum`; every other
annotation stands for an array. A status derives from `Status`, a command from `Command`. A class
without a version is only a base of others.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from difflib import get_close_matches
from enum import IntEnum
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, get_type_hints

import numpy as np

from rack.backplane.errors import MailboxError
from rack.backplane.message_type import Field, MessageType

REASON_BYTES = 120
COMMAND_ID = "id"
"""First field of every command: its serial."""
B = TypeVar("B", bound="Message")
_KINDS: Mapping[type, tuple[str, str]] = {
    bool: ("u1", "u"),
    int: ("i8", "iu"),
    float: ("f8", "f"),
    str: (f"S{REASON_BYTES}", "S"),
    IntEnum: ("u1", "iu"),
    np.ndarray: ("f8", "iufS"),
}
"""By type of a field: its numpy type unless the field states another, and the kinds permitted."""
_UNITS = {bool: "1", str: "ASCII"}
_UNSTATED = "unstated"
"""The unit, of any other type, of a field that states none."""


class State(IntEnum):
    """State of a level, in every status message."""

    IDLE = 0
    EXECUTING = 1
    DONE = 2
    ERROR = 3
    HOLDING = 4  # has work but must wait; `reason` says for what, and what ends the wait


def field(
    kind: str | type[Message] = "",
    *,
    doc: str,
    unit: str | type[IntEnum] = _UNSTATED,
    shape: int | str | tuple[int | str, ...] = (),
    length: tuple[float, float] | None = None,
    default: Any = None,
) -> Any:
    """Declare a field of a message class.

    Args:
        kind: Its numpy type if that is not the annotation's default (`f8` of a float or an array,
            `i8` of an int, `u1` of a bool or an `IntEnum`, `S120` of a str); or a message class:
            the field is one such group or, with a shape, an array of them.
        doc: What it says.
        unit: Its unit, "1" for a pure number, an `IntEnum` for an array of names; not given for a
            bool, a str, an enumeration and a group.
        shape: Shape of an array, of integers and symbolic sizes ("joints").
        length: The least and the greatest length of a vector, or magnitude of a number, that is
            taken from another rack.
        default: Value in the first message that a level writes; otherwise all bytes are 0.
    """
    sizes = shape if isinstance(shape, tuple) else (shape,)
    stored = kind if isinstance(kind, str) else kind.message_type
    return Field("", stored, unit, doc, sizes, length, default=default)


def _named(declared: Field, name: str, hint: Any) -> Field:
    """Return a declared field with the name and the annotation that stand beside it. Raises
    `ValueError` with a reason.
    """
    if isinstance(declared.kind, MessageType):
        return replace(declared, name=name, unit="")
    is_name = isinstance(hint, type) and issubclass(hint, IntEnum)
    python = IntEnum if is_name else hint if hint in _KINDS else np.ndarray
    usual, permitted = _KINDS[python]
    kind = declared.kind or usual
    if np.dtype(kind).kind not in permitted:
        raise ValueError(f"numpy type '{kind}' does not hold {_name(hint)}")
    if (python is np.ndarray) != bool(declared.shape):
        raise ValueError(f"shape {declared.shape} does not suit {_name(hint)}")
    unit = hint if python is IntEnum else _UNITS.get(python, declared.unit)
    if unit == _UNSTATED:
        raise ValueError('has no unit; of a pure number it is "1"')
    default = declared.default
    if default is not None and not _holds(kind, default):
        raise ValueError(f"default {default!r} does not fit numpy type '{kind}'")
    return replace(declared, name=name, kind=kind, unit=unit, python=python)


def make_message(name: str, version: int, base: type[B], fields: Mapping[str, Any]) -> type[B]:
    """Return a message class whose fields a config decides: integers, and groups.

    Args:
        name: Of the message.
        version: Of the message.
        base: Class whose fields come first.
        fields: What `field` returns, by name.
    """
    body = {**fields, "__annotations__": dict.fromkeys(fields, int), "__module__": __name__}
    made: Any = type(name, (base,), body, version=version, message=name)
    return made  # type: ignore[no-any-return]


class Message:
    """A local copy of one message: a mailbox reads into it or writes from it.

    Array fields are numpy views of `record`: fill them in place (`m.position[:] = q`) or assign
    (`m.position = q`). Scalars read and assign as plain values, texts as `str`, see `text_of`.
    A number that an enumeration does not name reads as a plain `int`: no reader fails because
    another board, or another version of a rack, sent it. `record` is the structured array, shape
    (), `raw` its bytes.
    """

    raw: memoryview
    record: np.ndarray
    message_type: ClassVar[MessageType] = MessageType("", 0, ())

    def __init_subclass__(cls, version: int = 0, message: str = "") -> None:
        """Collect the fields of a message class: those of its bases, then its own.

        Args:
            version: Of the message; it rises with every change of the fields. 0: the class is only
                a base of others.
            message: Name of the message; by default that of the class, as in "power_status".

        Raises:
            MailboxError: No message may have such a field.
        """
        fields = {f.name: f for base in cls.__bases__ for f in base.message_type.fields}  # type: ignore[attr-defined]
        own = {name: d for name, d in vars(cls).items() if isinstance(d, Field)}
        hints = get_type_hints(cls) if own else {}
        for name, declared in own.items():
            try:
                is_taken = hasattr(Message, name) or name in Message.__annotations__
                if name.startswith("_") or is_taken or name not in hints:
                    raise ValueError(
                        "permitted: annotated, no leading '_', no attribute of Message"
                    )
                fields[name] = _named(declared, name, hints[name])
            except (TypeError, ValueError) as error:
                raise MailboxError(
                    f"message class {cls.__name__}: field '{name}': {error}"
                ) from None
        known_as = message or re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        cls.message_type = MessageType(known_as, version, tuple(fields.values()))

    def __new__(cls, dtype: np.dtype, buffer: memoryview | None = None) -> Self:  # noqa: D102  # as the class
        made: Self = object.__new__(_resolved(cls, dtype))  # type: ignore[arg-type]
        return made

    def __init__(self, dtype: np.dtype, buffer: memoryview | None = None) -> None:
        raw = memoryview(bytearray(dtype.itemsize)) if buffer is None else buffer
        record = np.frombuffer(raw, dtype=dtype, count=1).reshape(())
        views = {name: record[name] for name in dtype.names or ()}
        self.__dict__.update(views, raw=raw, record=record, _views=views)

    @classmethod
    def zeros(cls, sizes: Mapping[str, int]) -> Self:
        """Return a message of this class, all bytes 0; `sizes` by name. Raises `MailboxError` when
        one is missing.
        """
        return cls(cls.message_type.dtype(sizes))

    def clear(self) -> None:
        """Set every byte to zero."""
        self.raw[:] = bytes(len(self.raw))

    def copy_from(self, other: Message) -> None:
        """Copy the bytes of a message of the same type."""
        self.raw[:] = other.raw

    if not TYPE_CHECKING:
        # A type checker knows the fields of a message class.
        def __setattr__(self, name: str, value: Any) -> None:
            # One call for all fields: the setter of a property would be a second one.
            try:
                self._views[name][...] = value
            except KeyError:
                raise AttributeError(self._unknown(name)) from None
            except UnicodeEncodeError:
                self._views[name][...] = value.encode("ascii", "replace")

        def __getattr__(self, name: str) -> Any:
            raise AttributeError(self._unknown(name))

    def _unknown(self, name: str) -> str:
        names = self.record.dtype.names or ()
        near = get_close_matches(name, names, 1)
        what = f"did you mean '{near[0]}'?" if near else f"fields: {', '.join(names)}"
        return f"message '{self.message_type.name}' has no field '{name}'; {what}"

    def __repr__(self) -> str:
        return f"Message({ {n: self.record[n].tolist() for n in self.record.dtype.names or ()} })"


class AnyMessage(Message):
    """A message whose fields are known at run time alone."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...
        def __setattr__(self, name: str, value: Any) -> None: ...


def integer(doc: str, kind: str = "u4") -> Any:
    """Declare a field that counts or numbers something, by a pure number of an integer type."""
    return field(kind, unit="1", doc=doc)


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
    number.
    """
    return State(state).name.lower() if state in set(State) else otherwise or str(state)


def copied(message: B) -> B:
    """Return a copy of a message, in memory of its own."""
    copy: B = object.__new__(type(message))
    copy.__init__(message.record.dtype, memoryview(bytearray(message.raw)))  # type: ignore[misc]
    return copy


def fill_counts(record: Any, counts: Iterable[float]) -> None:
    """Fill the fields of a record; an integer stays at the greatest that its field holds, whoever
    drives it.
    """
    kinds = (kind for kind, *_ in record.dtype.fields.values())
    record[...] = tuple(
        min(count, _greatest(kind)) for count, kind in zip(counts, kinds, strict=True)
    )


@cache
def _greatest(kind: np.dtype) -> float:
    return np.iinfo(kind).max if kind.kind in "iu" else np.inf


@cache
def _resolved(cls: type[B], dtype: np.dtype) -> type[B]:
    """Return the subclass of a message class with a property per scalar of this dtype."""
    declared = {field.name: field for field in cls.message_type.fields}
    columns = {name: dtype[name] for name in dtype.names or ()}
    body = {
        name: _scalar(name, column, declared.get(name))
        for name, column in columns.items()
        if not (column.shape or column.names)
    }
    kind = cls.message_type
    options = {"version": kind.version, "message": kind.name}
    made: Any = type(cls.__name__, (cls,), body, **options)
    return made  # type: ignore[no-any-return]


def _scalar(name: str, dtype: np.dtype, declared: Field | None) -> property:
    if dtype.kind == "S":
        return property(lambda self: text_of(self._views[name].item()))
    if declared is not None and declared.python is bool:
        return property(lambda self: self._views[name].item() != 0)
    if declared is not None and not isinstance(declared.unit, str):
        member = {int(each): each for each in declared.unit}.get
        return property(lambda self: member(value := self._views[name].item(), value))
    return property(lambda self: self._views[name].item())


def _name(hint: Any) -> str:
    return str(getattr(hint, "__name__", hint))


def _holds(kind: str, value: Any) -> bool:
    """Say whether a numpy type holds a value as it is."""
    try:
        stored = np.array(value, kind)
    except (OverflowError, TypeError, ValueError):
        return False
    plain = value.encode() if isinstance(value, str) else value
    return stored.dtype.kind == "f" or bool(np.all(stored == plain))


class Command(Message):
    """Base of the commands to a level."""

    id: int = field("u4", unit="1", doc="serial of the command; 0: no command")


class Status(Message):
    """Base of the statuses of levels."""

    echo: int = field("u4", unit="1", doc="serial of the command that this status answers")
    state: State = field(doc="idle, executing, done, error or holding")
    error: int = field("u2", unit="1", doc="error code of the level; 0: none")
    reason: str = field(doc="reason for the error or the hold, readable; empty: neither")
