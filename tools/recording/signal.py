"""A signal, as users name it: a field of the messages of a mailbox, or one number of it, as in
`servo.status.position[2]`; and a condition on one, as in `servo.status.position[2] > 1.2`.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from math import isnan
from typing import Any

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.backplane.message import text_of
from rack.tools.console.answer import Failure
from rack.tools.recording.parquet import Column, columns_of

NAME = re.compile(r"([\w.]+)((?:\[\d{1,9}\])*)")
CONDITION = re.compile(r"\s*(\S+?)\s*(==|!=|<=|>=|<|>)\s*(\S+)\s*")
COMPARISONS: dict[str, Callable[[Any, Any], Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
NEAREST = 3
"""Names offered in place of one that is not known, at most."""


@dataclass(frozen=True)
class Signal(Column):
    """Numbers, or text, in every message of a mailbox: a field, or part of an array field.

    Attributes:
        index: Indices into an array field, as far as they are given.
    """

    index: tuple[int, ...] = ()

    @classmethod
    def all(cls, boxes: Sequence[MailboxSpec]) -> dict[str, Signal]:
        """Return every whole field of these mailboxes by its name."""
        return {one.name: cls(**vars(one)) for box in boxes for one in columns_of(box)}

    @classmethod
    def of(cls, text: str, boxes: Sequence[MailboxSpec]) -> Signal:
        """Return the signal of that name. Raises `Failure` with the nearest names, or the permitted
        indices.
        """
        known = cls.all(boxes)
        found = NAME.fullmatch(text)
        if found is None or found[1] not in known:
            raise _unknown("signal", text, known, boxes)
        whole = known[found[1]]
        index = tuple(int(number) for number in re.findall(r"\d+", found[2]))
        shape = whole.shape[: len(index)]
        if len(shape) < len(index) or any(i >= n for i, n in zip(index, shape, strict=True)):
            ends = "".join(f"[0 to {size - 1}]" for size in whole.shape)
            raise Failure(f"{text}: no such index; permitted: {whole.name}{ends}", 2)
        return replace(whole, name=text, index=index)

    @property
    def unit(self) -> str:
        """Its unit; empty for counts, names and text."""
        unit = self.spec.unit
        return "" if self.spec.values or self.is_text or unit == "1" else unit

    @property
    def json_type(self) -> str:
        """The JSON type of one of its values."""
        if self.is_text or self.spec.values:
            return "string"
        return "number" if np.dtype(self.spec.kind).kind == "f" else "integer"

    @property
    def head(self) -> str:
        """Its name with its unit."""
        return f"{self.name}, {self.unit}".removesuffix(", ")

    @property
    def is_number(self) -> bool:
        """Whether it is a single number."""
        return len(self.index) == len(self.shape) and not self.is_text

    def values(self, messages: np.ndarray) -> np.ndarray:
        """Return it in each of these messages, shape (messages, *what is left of its own): a
        view.
        """
        return self.part(super().values(messages))

    def part(self, values: np.ndarray) -> np.ndarray:
        """Return it out of the values of its whole field, (messages, *shape of the field)."""
        place: Any = (slice(None), *self.index)
        found: np.ndarray = values[place]
        return found

    def in_message(self, message: np.ndarray) -> Any:
        """Return it in one message: an array or a number; a state by its name."""
        value = self.named(self.values(message[None]))[0]
        return text_of(value) if isinstance(value, bytes) else value

    def named(self, values: np.ndarray) -> np.ndarray:
        """Return its values with names in place of the numbers that stand for them."""
        if not self.spec.values:
            return values
        names = {number: name for name, number in self.spec.values}
        return np.asarray(np.vectorize(lambda number: names.get(number, number), "O")(values))

    def plain(self, messages: np.ndarray) -> list[Any]:
        """Return it in each of these messages as users read it: numbers, names of states, text,
        lists of them; None for what is not finite.
        """
        values = self.values(messages)
        if values.dtype.kind == "S":
            values = np.vectorize(text_of, "O")(values)
        elif self.spec.values:
            values = self.named(values)
        elif values.dtype.kind == "f" and not np.isfinite(values).all():
            values = np.where(np.isfinite(values), values, np.array(None))
        found: list[Any] = values.tolist()
        return found


def signals_of(box: MailboxSpec) -> list[Signal]:
    """Return the fields of a mailbox in their order."""
    return [*Signal.all([box]).values()]


def mailbox_of(name: str, boxes: Sequence[MailboxSpec]) -> MailboxSpec:
    """Return the mailbox of that name. Raises `Failure` with the nearest names."""
    known = {box.name: box for box in boxes}
    if name not in known:
        raise _unknown("mailbox", name, known, boxes)
    return known[name]


def _unknown(what: str, name: str, known: Collection[str], boxes: Sequence[MailboxSpec]) -> Failure:
    """Return the failure of a name that is not known: with the nearest, or all mailboxes."""
    near = get_close_matches(name.partition("[")[0], known, NEAREST)
    offered = "nearest" if near else "mailboxes"
    names = near or [box.name for box in boxes]
    return Failure(f"{name}: no such {what}; {offered}: {', '.join(names)}", 2)


@dataclass(frozen=True)
class Trigger:
    """A comparison of a signal, a single number, with a number."""

    signal: Signal
    sign: str
    number: float

    @classmethod
    def of(cls, text: str, boxes: Sequence[MailboxSpec]) -> Trigger:
        """Return the condition in a text. Raises `Failure`."""
        found = CONDITION.fullmatch(text)
        if found is None:
            example = "servo.status.position[2] > 1.2"
            raise Failure(f'"{text}": not a condition; permitted: as in "{example}"', 2)
        signal = Signal.of(found[1], boxes)
        if not signal.is_number:
            shape = list(signal.shape[len(signal.index) :])
            what = f"numbers of shape {shape}" if shape else "text"
            raise Failure(f"{signal.name}: {what}; a condition needs a single number", 2)
        names = dict(signal.spec.values)
        try:
            number = names[found[3]] if found[3] in names else float(found[3])
        except ValueError:
            known = f" or one of {', '.join(names)}" if names else ""
            raise Failure(f'"{text}": {found[3]} is not a number{known}', 2) from None
        if isnan(number):
            raise Failure(f'"{text}": nan is not a number to compare with', 2)
        return cls(signal, found[2], number)

    def holds(self, messages: np.ndarray) -> np.ndarray:
        """Return whether it holds in each of these messages, (messages,)."""
        return np.asarray(COMPARISONS[self.sign](self.signal.values(messages), self.number))
