"""Strict JSON encoder, the only one in the project.

JSON has no NaN and no infinity, and programs that read JSON reject a file that contains one.
"""

from __future__ import annotations

import json
from math import isfinite
from typing import Any


def encode_json(document: Any, indent: int | None = None) -> str:
    """Encode plain data as JSON. NaN and infinite numbers become null."""
    try:
        return json.dumps(document, indent=indent, allow_nan=False)
    except ValueError:
        return json.dumps(_replace_infinite(document), indent=indent, allow_nan=False)


def _replace_infinite(value: Any) -> Any:
    """Return a copy of plain data in which None replaces NaN and infinities."""
    if isinstance(value, dict):
        return {key: _replace_infinite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_infinite(inner) for inner in value]
    return None if isinstance(value, float) and not isfinite(value) else value
