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
        unit: Unit as text or, for numbers that stand for names, the enum.
        meaning: Meaning of the value.
        shape: Integers and symbolic sizes, () for a scalar.
        length: Least and greatest length of a vector along its last axis, or magnitude of a
            number.
        python: `bool`, `int`, `float`, `str`, `IntEnum` or `np.ndarray`. `object` for a group
            or a field made at run time.
        default: Value in the first message that a level writes. None for all bytes 0.
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
        """Return the numpy dtype with every symbolic size filled in.

        Padding is explicit in numpy's aligned layout, zeroed at creation and never written, so
        equal messages have equal bytes.

        Args:
            sizes: Symbolic sizes by name.

        Raises:
            MailboxError: `sizes` lacks a size.
        """
        return np.dtype([self._build_column(f, sizes) for f in self.fields], align=True)

    def _build_column(
        self, field: Field, sizes: Mapping[str, int]
    ) -> tuple[str, Any, tuple[int, ...]]:
        """Return the entry of the numpy dtype for one field: name, type and shape."""
        kind = (
            field.kind.build_dtype(sizes)
            if isinstance(field.kind, MessageType)
            else np.dtype(field.kind)
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
