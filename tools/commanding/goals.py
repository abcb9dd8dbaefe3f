"""The goal of a command as it is typed: "home", or key=value with numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rack.tools.answer import Failure

KEYS = ("joints", "position", "quaternion", "direction")


def goal_of(words: Sequence[str]) -> dict[str, Any]:
    """Return a goal as in a `[[command]]` table. Raises `Failure` that names the word and what is permitted."""
    goal: dict[str, Any] = {}
    for word in words:
        key, is_given, values = word.partition("=")
        if word == "home":
            goal["home"] = True
        elif not is_given or key not in KEYS:
            raise Failure(f"'{word}' is no goal; permitted: home, {', '.join(f'{k}=...' for k in KEYS)}", 2)
        elif key in goal:
            raise Failure(f"'{word}': {key} is given twice", 2)
        else:
            goal[key] = [_number(value, word) for value in values.split(",")]
    return goal


def _number(text: str, word: str) -> float:
    try:
        return float(text)
    except ValueError:
        why = f"'{text}' is not a number; permitted: numbers with commas between, as in joints=0,0.5,1"
        raise Failure(f"'{word}': {why}", 2) from None
