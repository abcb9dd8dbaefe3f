"""Parameters of a level, from `[board.<name>.params]`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from rack.levels.errors import LevelError
from rack.levels.robot import Table

Params = TypeVar("Params", bound=Table)


def read_params(kind: type[Params], params: Mapping[str, Any]) -> Params:
    """Return `params` as `kind`. Raises `LevelError` that names the key, its value and what is valid."""
    try:
        return kind(**params)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        valid = ", ".join(kind.model_fields)
        raise LevelError(f"params.{key} = {first['input']!r}: {first['msg'].lower()}; keys: {valid}") from error
