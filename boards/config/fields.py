"""Message types resolved to field specs: byte offsets and shapes, for tools that attach by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rack.backplane.layout import FieldSpec
from rack.backplane.message import MessageType


def field_specs(kind: MessageType, sizes: Mapping[str, int]) -> tuple[FieldSpec, ...]:
    """Return the fields of a message type with their offsets, shapes and numpy types."""
    offsets: Mapping[str, Any] = kind.dtype(sizes).fields or {}
    specs = []
    for field in kind.fields:
        dtype, offset = offsets[field.name][:2]
        scalar, shape = dtype.subdtype or (dtype, ())
        is_group = isinstance(field.kind, MessageType)
        specs.append(
            FieldSpec(
                name=field.name,
                kind=f"V{scalar.itemsize}" if is_group else np.dtype(scalar).str,
                shape=tuple(shape),
                offset=offset,
                unit=field.unit if isinstance(field.unit, str) else field.unit.__name__,
                meaning=field.meaning,
                values=() if isinstance(field.unit, str) else tuple((n.name.lower(), int(n)) for n in field.unit),
                fields=field_specs(field.kind, sizes) if isinstance(field.kind, MessageType) else (),
            )
        )
    return tuple(specs)
