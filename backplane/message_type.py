"""Message types: fixed numpy structured layouts, documented field by field.

A message type is declared once, as a class (see `rack.backplane.message`), with symbolic sizes
("joints"), which a rack resolves from its config.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from rack.backplane.errors import MailboxError


@dataclass(frozen=True)
class Field:
    """One field of a message.

    Attributes:
        name: Its name.
        kind: A numpy type string or, for a group of fields, the type of the group.
        unit: Its unit; of a number that stands for a name, the enumeration.
        meaning: What it says.
        shape: Integers and symbolic sizes; empty for a scalar.
        length: The least and the greatest length that a vector, along its last axis, or the
            magnitude of a number may have.
        python: `bool`, `int`, `float`, `str`, `IntEnum` or `np.ndarray`; `object` if the field is
            a group, or was made at run time.
        default: Value in the first message that a level writes; None: all bytes are 0.
    """

    name: str
    kind: str | MessageType
    unit: str | type[IntEnum]
    meaning: str
    shape: tuple[int | str, ...] = ()
    length: tuple[float, float] | None = None
    python: type = object
    default: Any = None


@dataclass(frozen=True)
class MessageType:
    """A named, versioned layout. `fields` are ordered by offset."""

    name: str
    version: int
    fields: tuple[Field, ...]

    def dtype(self, sizes: Mapping[str, int]) -> np.dtype:
        """Return the numpy dtype with every symbolic size filled in.

        Padding is explicit in numpy's aligned layout, zeroed once at creation and never written, so
        that equal messages have equal bytes.

        Raises:
            MailboxError: `sizes` lacks a size.
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
