"""Message classes, whose instances are local copies of one message with fields as attributes.

```python
class PowerStatus(Status, version=1):
    \"\"\"Power drawn by the arm.\"\"\"

    power: float = field(unit="W", doc="mechanical power")
    torque: np.ndarray = field(unit="N m", doc="applied torque", shape="joints")
```

A scalar field is annotated `float`, `int`, `bool`, `str` or with an `IntEnum`. Every other
annotation declares an array. A status derives from `Status`, a command from `Command`. A class
without a version is only a base class.
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
"""First field of every command: its serial number."""
B = TypeVar("B", bound="Message")
_KINDS: Mapping[type, tuple[str, str]] = {
    bool: ("u1", "u"),
    int: ("i8", "iu"),
    float: ("f8", "f"),
    str: (f"S{REASON_BYTES}", "S"),
    IntEnum: ("u1", "iu"),
    np.ndarray: ("f8", "iufS"),
}
"""Default numpy type of a field and the permitted numpy kinds, by the annotated type."""
_UNITS = {bool: "1", str: "ASCII"}
_UNSTATED = "unstated"
"""Unit of a field that states none."""


class State(IntEnum):
    """State of a level, in every status message."""

    IDLE = 0
    EXECUTING = 1
    DONE = 2
    ERROR = 3
    HOLDING = 4  # has work but must wait; `reason` states for what, and what ends the wait


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
        kind: numpy type. By default it follows from the annotation: `f8` for a float or an array,
            `i8` for an int, `u1` for a bool or an `IntEnum`, `S120` for a str. If `kind` is a
            message class, the field is a group with the fields of that class or, with a shape, an
            array of such groups.
        doc: Meaning of the value.
        unit: Unit, "1" for a pure number. For an array of enum values, the `IntEnum`. Omit it for
            a bool, a str, an enum or a group.
        shape: Shape of an array: integers and symbolic sizes such as "joints".
        length: Smallest and largest norm of a vector, or magnitude of a number, that is accepted
            from another rack.
        default: Value in the first message that a level writes. None sets all bytes to 0.
    """
    sizes = shape if isinstance(shape, tuple) else (shape,)
    stored = kind if isinstance(kind, str) else kind.message_type
    return Field("", stored, unit, doc, sizes, length, default=default)


def _complete_field(declared: Field, name: str, hint: Any) -> Field:
    """Complete a declared field with its name, and with the type and unit from its annotation.

    Args:
        declared: Result of `field`.
        name: Name of the field.
        hint: Annotation of the field.

    Raises:
        ValueError: The type, shape, unit or default does not suit the annotation.
    """
    if isinstance(declared.kind, MessageType):
        return replace(declared, name=name, unit="")
    is_name = isinstance(hint, type) and issubclass(hint, IntEnum)
    name_of_hint = getattr(hint, "__name__", hint)
    python = IntEnum if is_name else hint if hint in _KINDS else np.ndarray
    usual, permitted = _KINDS[python]
    kind = declared.kind or usual
    if np.dtype(kind).kind not in permitted:
        raise ValueError(f"numpy type '{kind}' does not hold {name_of_hint}")
    if (python is np.ndarray) != bool(declared.shape):
        raise ValueError(f"shape {declared.shape} does not suit {name_of_hint}")
    unit = hint if python is IntEnum else _UNITS.get(python, declared.unit)
    if unit == _UNSTATED:
        raise ValueError('has no unit; the unit of a pure number is "1"')
    default = declared.default
    if default is not None and not _can_store(kind, default):
        raise ValueError(f"default {default!r} does not fit numpy type '{kind}'")
    return replace(declared, name=name, kind=kind, unit=unit, python=python)


def make_message(name: str, base: type[B], fields: Mapping[str, Any]) -> type[B]:
    """Create version 1 of a message class whose fields are known only at run time.

    Args:
        name: Name of the message.
        base: Class whose fields come first.
        fields: Fields to add after those of `base`: a dictionary from the name of a field to the
            result of `field`. Each must be an integer or a group.
    """
    body = {**fields, "__annotations__": dict.fromkeys(fields, int), "__module__": __name__}
    message_class: Any = type(name, (base,), body, version=1, message=name)
    return message_class  # type: ignore[no-any-return]


class Message:
    """Local copy of one message: a reader fills it from its mailbox, a writer publishes it.

    Array fields are numpy views of `record`. Fill them in place (`m.position[:] = q`) or assign to
    them (`m.position = q`). Scalars are read and assigned as plain values, texts as `str` (see
    `decode_text`). A number for which an enum has no member is read as a plain `int`, so a reader
    does not fail because another board, or another version of a rack, sent it.

    Attributes:
        raw: Bytes of the message.
        record: Structured array of shape () over these bytes.
        message_type: Name, version and fields of the message.
    """

    raw: memoryview
    record: np.ndarray
    message_type: ClassVar[MessageType] = MessageType("", 0, ())

    def __init_subclass__(cls, version: int = 0, message: str = "") -> None:
        """Collect the fields of a message class, beginning with the fields of its bases.

        Args:
            version: Version of the message, which rises with every change of the fields. 0 for
                a class that is only a base of others.
            message: Name of the message. By default it is derived from the class, such as
                "power_status".

        Raises:
            MailboxError: A message cannot have such a field.
        """
        fields = {f.name: f for base in cls.__bases__ for f in base.message_type.fields}  # type: ignore[attr-defined]
        declared_fields = {name: d for name, d in vars(cls).items() if isinstance(d, Field)}
        hints = get_type_hints(cls) if declared_fields else {}
        for name, declared in declared_fields.items():
            try:
                is_taken = hasattr(Message, name) or name in Message.__annotations__
                if name.startswith("_") or is_taken or name not in hints:
                    raise ValueError(
                        "must be annotated, without leading '_', and not named like an attribute"
                        " of Message"
                    )
                fields[name] = _complete_field(declared, name, hints[name])
            except (TypeError, ValueError) as error:
                raise MailboxError(
                    f"message class {cls.__name__}: field '{name}': {error}"
                ) from None
        known_as = message or re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        cls.message_type = MessageType(known_as, version, tuple(fields.values()))

    def __new__(cls, dtype: np.dtype, buffer: memoryview | None = None) -> Self:  # noqa: D102  # as the class
        message: Self = object.__new__(_build_class(cls, dtype))  # type: ignore[arg-type]
        return message

    def __init__(self, dtype: np.dtype, buffer: memoryview | None = None) -> None:
        raw = memoryview(bytearray(dtype.itemsize)) if buffer is None else buffer
        record = np.frombuffer(raw, dtype=dtype, count=1).reshape(())
        views = {name: record[name] for name in dtype.names or ()}
        self.__dict__.update(views, raw=raw, record=record, _views=views)

    @classmethod
    def zeros(cls, sizes: Mapping[str, int]) -> Self:
        """Create a message of this class with all bytes 0.

        Args:
            sizes: Values of the symbolic sizes, keyed by name.

        Raises:
            MailboxError: A size is missing.
        """
        return cls(cls.message_type.build_dtype(sizes))

    def clear(self) -> None:
        """Set every byte to zero."""
        self.raw[:] = bytes(len(self.raw))

    def copy_from(self, other: Message) -> None:
        """Copy the content of another message of the same type into this one."""
        self.raw[:] = other.raw

    if not TYPE_CHECKING:
        # A type checker knows the fields of a message class.
        def __setattr__(self, name: str, value: Any) -> None:
            # A property setter per field would cost a second call.
            try:
                self._views[name][...] = value
            except KeyError:
                raise AttributeError(self._describe_unknown_field(name)) from None
            except UnicodeEncodeError:
                self._views[name][...] = value.encode("ascii", "replace")

        def __getattr__(self, name: str) -> Any:
            raise AttributeError(self._describe_unknown_field(name))

    def _describe_unknown_field(self, name: str) -> str:
        """Return the error text for an unknown field, with the most similar name or all names."""
        names = self.record.dtype.names or ()
        near = get_close_matches(name, names, 1)
        hint = f"did you mean '{near[0]}'?" if near else f"fields: {', '.join(names)}"
        return f"message '{self.message_type.name}' has no field '{name}'; {hint}"

    def __repr__(self) -> str:
        return f"Message({ {n: self.record[n].tolist() for n in self.record.dtype.names or ()} })"


class AnyMessage(Message):
    """Message whose fields are known only at run time."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...
        def __setattr__(self, name: str, value: Any) -> None: ...


def integer_field(doc: str, kind: str = "u4") -> Any:
    """Declare an integer field without a unit, such as a count or an index."""
    return field(kind, unit="1", doc=doc)


def decode_text(content: bytes | bytearray) -> str:
    """Decode a text field for display, with control characters escaped."""
    return escape_text(content.decode("ascii", "replace"))


def escape_text(text: str) -> str:
    """Replace control characters in a text with printable escape sequences.

    Texts from other racks and from users' levels are printed on terminals, which would execute the
    control sequences in them.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def get_reason(status: Message) -> str:
    """Return the `reason` of a status, or an empty string if the status has no such field."""
    return str(getattr(status, "reason", ""))


def format_state(state: int | None, otherwise: str = "") -> str:
    """Return the name of a level's state in lower case.

    Args:
        state: Number of the state. None is treated like a number that `State` does not define.
        otherwise: Result for a number that `State` does not define. If it is empty, the result is
            the number as text.
    """
    return State(state).name.lower() if state in set(State) else otherwise or str(state)


def copy_message(message: B) -> B:
    """Return a copy of a message that does not share memory with it."""
    copy: B = object.__new__(type(message))
    copy.__init__(message.record.dtype, memoryview(bytearray(message.raw)))  # type: ignore[misc]
    return copy


def fill_counts(record: Any, counts: Iterable[float]) -> None:
    """Assign counts to the fields of a record, in order.

    A count that is too large for an integer field is stored as the largest value of the field.
    """
    record[...] = tuple(map(min, counts, _find_maxima(record.dtype)))


@cache
def _find_maxima(group: np.dtype) -> tuple[float, ...]:
    """Return the largest value that each field of a numpy record type can store."""
    kinds = [kind for kind, *_ in (group.fields or {}).values()]
    return tuple(np.iinfo(kind).max if kind.kind in "iu" else np.inf for kind in kinds)


@cache
def _build_class(cls: type[B], dtype: np.dtype) -> type[B]:
    """Build a subclass of a message class that has a property for each scalar field.

    Args:
        cls: Message class.
        dtype: dtype of its messages, with all sizes known.
    """
    declared = {field.name: field for field in cls.message_type.fields}
    body = {
        name: _build_scalar_property(name, dtype[name], declared.get(name))
        for name in dtype.names or ()
        if not (dtype[name].shape or dtype[name].names)
    }
    kind = cls.message_type
    resolved_class: Any = type(cls.__name__, (cls,), body, version=kind.version, message=kind.name)
    return resolved_class  # type: ignore[no-any-return]


def _build_scalar_property(name: str, dtype: np.dtype, declared: Field | None) -> property:
    """Build a property that returns a scalar field as a `str`, `bool`, enum member or number."""
    if dtype.kind == "S":
        return property(lambda self: decode_text(self._views[name].item()))
    if declared is not None and declared.python is bool:
        return property(lambda self: self._views[name].item() != 0)
    if declared is not None and not isinstance(declared.unit, str):
        member = {int(each): each for each in declared.unit}.get
        return property(lambda self: member(value := self._views[name].item(), value))
    return property(lambda self: self._views[name].item())


def _can_store(kind: str, value: Any) -> bool:
    """Check whether a numpy type can store a value. Rounding of a float is permitted."""
    try:
        stored = np.array(value, kind)
    except (OverflowError, TypeError, ValueError):
        return False
    plain = value.encode() if isinstance(value, str) else value
    return stored.dtype.kind == "f" or bool(np.all(stored == plain))


class Command(Message):
    """Base class of the commands to a level."""

    id: int = integer_field("serial of the command (0: no command)")


class Status(Message):
    """Base class of the statuses of levels."""

    echo: int = integer_field("serial of the command that this status answers")
    state: State = field(doc="idle, executing, done, error or holding")
    error: int = integer_field("error code of the level (0: none)", "u2")
    reason: str = field(doc="reason for the error or the hold (empty: neither)")
