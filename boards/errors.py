"""The exception tree of the boards, and where each one shows.

`BoardError` is the root: catch it and every refusal of this package is caught.

- `ConfigError`: a config with mistakes, all of them at once, before any process starts.
- `LaunchError`: a board that does not start: its self-test failed, or it is not ready in time.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

LONGEST_VALUE = 80


class BoardError(Exception):
    """Root of every error this package raises; its text is one line for the user."""


class LaunchError(BoardError):
    """A rack that cannot be launched, though its config is right."""


@dataclass(frozen=True)
class Mistake:
    """One mistake of a config: where it stands, what stands there (None: nothing), why not and what is permitted."""

    place: str
    value: Any
    why: str

    def __str__(self) -> str:
        """Return the mistake as one line."""
        return f"{self.place}: {self.why}" if self.value is None else f"{self.place} = {shown(self.value)}: {self.why}"


class ConfigError(BoardError):
    """A config that cannot run. `mistakes` holds every mistake found; the text has one line for each."""

    def __init__(self, mistakes: Iterable[Mistake]) -> None:
        self.mistakes = list({str(mistake): mistake for mistake in mistakes}.values())
        super().__init__("\n".join(str(mistake) for mistake in self.mistakes))


def shown(value: Any) -> str:
    """Return a config value as TOML would have it, cut to one short line."""
    text = str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else str(value)
    text = " ".join(text.split())
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 3] + "..."
