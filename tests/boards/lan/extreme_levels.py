"""A level that sends every field of a message type its extremes, one after the other: see
`test_extremes`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Any

import numpy as np

from rack.backplane.message import AnyMessage, Message
from rack.backplane.message_type import Field, MessageType
from rack.boards.lan.config import ImportConfig
from rack.levels.level import ConfiguredPorts, Executor, LevelContext, Output

Case = tuple[str, bytes, bool]
"""What is extreme, the message, and whether its type permits it."""


class Extremes(Executor):
    """Writes each case of `params.cases`, a number of cycles and bytes in hexadecimal, then the
    last one for ever."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._rows = [
            bytes.fromhex(row) for cycles, row in context.params["cases"] for _ in range(cycles)
        ]

    @classmethod
    def build_ports(
        cls, params: Mapping[str, Any], types: Mapping[str, type[Message]]
    ) -> ConfiguredPorts:
        return ConfiguredPorts(outputs={params["port"]: Output(message_class(params["type"]))})

    def process(self, tick: int) -> None:
        at = min(tick // self.context.every, len(self._rows) - 1)
        self.ports[self.context.params["port"]].raw[:] = self._rows[at]


def message_class(name: str) -> type[Message]:
    """Return a message class by its name in a config."""
    table = {"from": "x/x.x", "type": name, "rate_hz": 1, "max_age_ms": 1}
    return ImportConfig.model_validate(table).find_message_class()


def cases(
    kind: type[Message], base: Mapping[str, Any], sizes: Mapping[str, int] | None = None
) -> Iterator[Case]:
    """Yield the base itself, and the base with each field at each of its extremes. A group's are
    those of its first."""
    plain = filled(kind, base, sizes)
    yield "plain", bytes(plain.raw), True
    for path, field in _leaves(kind.message_type.fields):
        for value in _extremes(field, plain.record.dtype, path):
            message = filled(kind, base, sizes)
            message.record[path[0]][...] = message.record[path[0]]
            at: Any = message.record
            for name in path[:-1]:
                at = at[name][0]
            before = at[path[-1]].tobytes()
            at[path[-1]] = value
            if at[path[-1]].tobytes() != before:
                yield (
                    f"{'.'.join(path)} = {value!r}",
                    bytes(message.raw),
                    _is_permitted(field, at[path[-1]]),
                )


def filled(
    kind: type[Message], base: Mapping[str, Any], sizes: Mapping[str, int] | None = None
) -> Message:
    message = AnyMessage(kind.message_type.build_dtype(sizes or {}))
    for name, value in base.items():
        if isinstance(value, Mapping):
            for inner, number in value.items():
                message.record[name][0][inner] = number
        else:
            message.record[name] = value
    return message


def _leaves(
    fields: Iterable[Field], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Field]]:
    for field in fields:
        if isinstance(field.kind, MessageType):
            yield from _leaves(field.kind.fields, (*path, field.name))
        else:
            yield (*path, field.name), field


def _extremes(field: Field, dtype: np.dtype, path: Sequence[str]) -> Sequence[Any]:
    kind = np.dtype(str(field.kind))
    if kind.kind == "f":
        most = float(np.finfo(kind).max)
        return 0.0, most, -most, math.inf, -math.inf, math.nan
    if kind.kind == "S":
        return b"", b"\xff" * kind.itemsize, b"x" * kind.itemsize
    info = np.iinfo(kind)
    return 0, int(info.min), int(info.max)


def _is_permitted(field: Field, value: Any) -> bool:
    """Say what the declaration of a field permits, by other means than the product's."""
    if isinstance(field.unit, type) and issubclass(field.unit, IntEnum):
        return int(value) in [int(member) for member in field.unit]
    if np.dtype(str(field.kind)).kind == "S":
        return bytes(value).isascii()
    numbers = [float(number) for number in np.ravel(value)]
    if not all(math.isfinite(number) for number in numbers):
        return False
    return field.length is None or field.length[0] <= math.hypot(*numbers) <= field.length[1]
