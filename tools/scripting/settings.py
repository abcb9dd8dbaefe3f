"""Converts settings in Python values to the form of `--set`, for a rack that a program launches."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rack.boards.errors import ConfigError, Mistake


def list_settings(tables: Mapping[str, Any], outer: str = "") -> Iterator[str]:
    """Convert tables of Python values to settings, in the form that --set takes.

    Args:
        tables: Dictionary from key to value. Keys may be dotted, and values may be tables.
        outer: Dotted prefix of all keys.

    Raises:
        ConfigError: TOML cannot express a value.
    """
    for key, value in tables.items():
        if isinstance(value, Mapping) and value:
            yield from list_settings(value, f"{outer}{key}.")
        else:
            try:
                yield f"{outer}{key}={_format_inline(value)}"
            except TypeError as error:
                raise ConfigError([Mistake("settings", f"{outer}{key}", str(error))]) from None


def _format_inline(value: Any) -> str:
    """Format a Python value as TOML on one line. Arrays become lists, paths become strings."""
    if isinstance(value, Mapping):
        items = (
            f"{_format_inline(str(key))} = {_format_inline(item)}" for key, item in value.items()
        )
        return f"{{{', '.join(items)}}}"
    if isinstance(value, np.ndarray | list | tuple):
        return f"[{', '.join(map(_format_inline, value))}]"
    plain = str(value) if isinstance(value, Path) else value
    plain = plain.item() if isinstance(plain, np.generic) else plain
    return tomli_w.dumps({"value": plain}).partition("=")[2].strip()
