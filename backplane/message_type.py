"""Message types: fixed numpy structured layouts, documented field by field.

A message type is declared as a class (see `rack.backplane.message`) with symbolic sizes ("joints"),
which a rack resolves from its config.
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
    """Declaration of one field of a message.

    Attributes:
        name: Name of the field.
        kind: numpy type string or, for a group of fields, the type of the group.
        unit: Unit as text. For an enum, the enum class.
        meaning: Meaning of the value.
        shape: Integers and symbolic sizes, () for a scalar.
        length: Smallest and largest permitted norm of a vector along its last axis, or magnitude
            of a number. None if there is no such limit.
        python: `bool`, `int`, `float`, `str`, `IntEnum` or `np.ndarray`. `object` for a group
            of fields.
        default: Value in the first message that a level writes. None sets all bytes to 0.
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
    """Named and versioned message layout. `fields` are ordered by offset."""

    name: str
    version: int
    fields: tuple[Field, ...]

    def build_dtype(self, sizes: Mapping[str, int]) -> np.dtype:
        """Return the numpy dtype of the message, with symbolic sizes replaced by numbers.

        Equal messages have equal bytes, because padding is zeroed at creation and never written.

        Args:
            sizes: Values of the symbolic sizes, keyed by name.

        Raises:
            MailboxError: `sizes` does not contain a size that a field uses.
        """
        return np.dtype([self._build_column(f, sizes) for f in self.fields], align=True)

    def _build_column(
        self, field: Field, sizes: Mapping[str, int]
    ) -> tuple[str, Any, tuple[int, ...]]:
        """Return name, numpy type and shape of one field, with symbolic sizes as numbers."""
        kind = (
            field.kind.build_dtype(sizes)
            if isinstance(field.kind, MessageType)
            else np.dtype(field.kind)
        )
        missing = [s for s in field.shape if isinstance(s, str) and s not in sizes]
        if missing:
            raise MailboxError(
                f"message '{self.name}' field '{field.name}': size '{missing[0]}' is unknown; known"
                f" sizes: {', '.join(sorted(sizes)) or 'none'}"
            )
        return field.name, kind, tuple(sizes[s] if isinstance(s, str) else s for s in field.shape)
