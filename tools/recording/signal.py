"""Parses signals and conditions as users write them.

A signal is a field of a mailbox's messages, or one number of it, as in `servo.status.position[2]`.
A condition compares a signal with a number, as in `servo.status.position[2] > 1.2`.
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
from rack.backplane.message import decode_text
from rack.tools.console.answer import Failure
from rack.tools.recording.parquet import Column, list_columns

NAME_PATTERN = re.compile(r"([\w.]+)((?:\[\d{1,9}\])*)")
CONDITION_PATTERN = re.compile(r"\s*(\S+?)\s*(==|!=|<=|>=|<|>)\s*(\S+)\s*")
COMPARISONS: dict[str, Callable[[Any, Any], Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
MAX_SUGGESTIONS = 3
"""Number of similar names that are suggested for an unknown name."""


@dataclass(frozen=True)
class Signal(Column):
    """A field of a mailbox's messages, or an indexed part of an array field.

    Values are numbers, text, or numbers that stand for names, such as the state of a level.

    Attributes:
        index: Indices into an array field. They may select one number or a row. Empty for the
            whole field.
    """

    index: tuple[int, ...] = ()

    @classmethod
    def build_by_name(cls, boxes: Sequence[MailboxSpec]) -> dict[str, Signal]:
        """Return a dictionary from name to signal, with every field of these mailboxes."""
        return {column.name: cls(**vars(column)) for box in boxes for column in list_columns(box)}

    @classmethod
    def parse(cls, text: str, boxes: Sequence[MailboxSpec]) -> Signal:
        """Parse the name of a signal.

        Raises:
            Failure: The name is unknown, or the index is out of range. The message lists similar
                names or the valid indices.
        """
        known = cls.build_by_name(boxes)
        match = NAME_PATTERN.fullmatch(text)
        if match is None or match[1] not in known:
            raise _build_failure("signal", text, known, boxes)
        whole = known[match[1]]
        index = tuple(int(number) for number in re.findall(r"\d+", match[2]))
        shape = whole.shape[: len(index)]
        if len(shape) < len(index) or any(i >= n for i, n in zip(index, shape, strict=True)):
            valid = "".join(f"[0 to {size - 1}]" for size in whole.shape)
            raise Failure(f"{text}: no such index; valid: {whole.name}{valid}", 2)
        return replace(whole, name=text, index=index)

    @property
    def unit(self) -> str:
        """Unit of the signal. Empty for counts, named states and text."""
        unit = self.spec.unit
        return "" if self.spec.values or self.is_text or unit == "1" else unit

    @property
    def heading(self) -> str:
        """Name and unit, as the heading of a column."""
        return f"{self.name}, {self.unit}".removesuffix(", ")

    def extract_values(self, messages: np.ndarray) -> np.ndarray:
        """Return the signal's value in each message.

        Returns:
            A view of shape (messages, *shape of one value).
        """
        return self.select_part(super().extract_values(messages))

    def select_part(self, values: np.ndarray) -> np.ndarray:
        """Return the indexed part of the values of the whole field.

        Args:
            values: Value of the field in each message, shape (messages, *shape of the field).
        """
        place: Any = (slice(None), *self.index)
        selected: np.ndarray = values[place]
        return selected

    def read_message(self, message: np.ndarray) -> Any:
        """Return the signal's value in one message: a number, an array, text or a name."""
        value = self.replace_numbers(self.extract_values(message[None]))[0]
        return decode_text(value) if isinstance(value, bytes) else value

    def replace_numbers(self, values: np.ndarray) -> np.ndarray:
        """Replace numbers that stand for names, such as states, with the names.

        Values of other signals are returned unchanged.
        """
        if not self.spec.values:
            return values
        names = {number: name for name, number in self.spec.values}
        return np.asarray(np.vectorize(lambda number: names.get(number, number), "O")(values))

    def extract_plain(self, messages: np.ndarray) -> list[Any]:
        """Return the signal's value in each message as plain Python data.

        Returns:
            Numbers, names, text, or nested lists of these. Numbers that are not finite become None.
        """
        values = self.extract_values(messages)
        if values.dtype.kind == "S":
            values = np.vectorize(decode_text, "O")(values)
        elif self.spec.values:
            values = self.replace_numbers(values)
        elif values.dtype.kind == "f" and not np.isfinite(values).all():
            values = np.where(np.isfinite(values), values, np.array(None))
        plain_values: list[Any] = values.tolist()
        return plain_values


def list_signals(box: MailboxSpec) -> list[Signal]:
    """Return a signal for each field of a mailbox, in the order of the fields."""
    return [*Signal.build_by_name([box]).values()]


def find_mailbox(name: str, boxes: Sequence[MailboxSpec]) -> MailboxSpec:
    """Return the mailbox with this name. If there is none, raises `Failure` with similar names."""
    known = {box.name: box for box in boxes}
    if name not in known:
        raise _build_failure("mailbox", name, known, boxes)
    return known[name]


def _build_failure(
    what: str, name: str, known: Collection[str], boxes: Sequence[MailboxSpec]
) -> Failure:
    """Return the `Failure` for an unknown name.

    Args:
        what: Kind of the name, "signal" or "mailbox".
        name: The unknown name.
        known: The valid names. The message lists those that are similar to `name`.
        boxes: Mailboxes. The message lists them if no valid name is similar.
    """
    near = get_close_matches(name.partition("[")[0], known, MAX_SUGGESTIONS)
    offered = "nearest" if near else "mailboxes"
    names = near or [box.name for box in boxes]
    return Failure(f"{name}: no such {what}; {offered}: {', '.join(names)}", 2)


@dataclass(frozen=True)
class Trigger:
    """A condition that compares a signal with a constant.

    Attributes:
        signal: The signal, which is a single number.
        comparison: The comparison operator.
        number: The constant.
    """

    signal: Signal
    comparison: str
    number: float

    @classmethod
    def parse(cls, text: str, boxes: Sequence[MailboxSpec]) -> Trigger:
        """Parse a condition such as "servo.status.position[2] > 1.2".

        Raises:
            Failure: The text is not a condition, or its signal is unknown or not a single number.
        """
        match = CONDITION_PATTERN.fullmatch(text)
        if match is None:
            example = "servo.status.position[2] > 1.2"
            raise Failure(f'"{text}" is not a condition; write one like "{example}"', 2)
        signal = Signal.parse(match[1], boxes)
        shape = list(signal.shape[len(signal.index) :])
        if shape or signal.is_text:
            what = f"numbers of shape {shape}" if shape else "text"
            raise Failure(f"{signal.name} is {what}; a condition needs a single number", 2)
        names = dict(signal.spec.values)
        try:
            number = names[match[3]] if match[3] in names else float(match[3])
        except ValueError:
            known = f" or one of {', '.join(names)}" if names else ""
            raise Failure(f'"{text}": {match[3]} is not a number{known}', 2) from None
        if isnan(number):
            raise Failure(f'"{text}": nothing can be compared with nan', 2)
        return cls(signal, match[2], number)

    def evaluate_messages(self, messages: np.ndarray) -> np.ndarray:
        """Return True for each message that meets the condition, shape (messages,)."""
        return self.evaluate_values(self.signal.extract_values(messages))

    def evaluate_values(self, values: np.ndarray) -> np.ndarray:
        """Return True for each value of the signal that meets the condition, shape (messages,)."""
        return np.asarray(COMPARISONS[self.comparison](values, self.number))
