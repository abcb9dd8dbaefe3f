"""The exception tree of the boards, with the cause of each error.

`BoardError` is the root: catch it and every refusal of this package is caught.

- `ConfigError`: a config with mistakes, all of them at once, before any process starts.
- `LaunchError`: a board that did not start: its self-test failed, or it was not ready in time.
- `SnapshotError`: a process that cannot be copied, or a snapshot from which a rack cannot go on.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

LONGEST_VALUE = 80
LONGEST_PLACE = 120
LONGEST_REASON = 1000
CANNOT_GO_ON = 4
"""Exit status of a board that a restart would not help."""

UNKEPT = "no snapshots: "
"""Begins the note of a run that takes none, with the reason after it."""


class Failure(Exception):
    """A command, or a call of a program, that did not work. The message is for the user, `status`
    the exit status of the command.
    """

    def __init__(self, reason: str, status: int = 1) -> None:
        super().__init__(reason)
        self.status = status


class BoardError(Failure):
    """Root of every error this package raises; its text is one line for the user."""


class LaunchError(BoardError):
    """A rack with a correct config that cannot be launched."""


class SnapshotError(BoardError):
    """A process that cannot be copied, or a snapshot from which a rack cannot go on."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason, 2)


@dataclass(frozen=True)
class Mistake:
    """One mistake in a config: its place, the value there (None: none), and the reason or the
    permitted values.
    """

    place: str
    value: Any
    why: str

    def __str__(self) -> str:
        """Return the mistake as one line."""
        value = "" if self.value is None else f" = {shown(self.value)}"
        return f"{one_line(self.place, LONGEST_PLACE)}{value}: {one_line(self.why, LONGEST_REASON)}"


Mistakes = Iterator[Mistake]
"""What a rule yields."""


class ConfigError(BoardError):
    """A config that cannot run. `mistakes` holds every mistake found; the text has one line per
    mistake.
    """

    def __init__(self, mistakes: Iterable[Mistake]) -> None:
        self.mistakes = list({str(mistake): mistake for mistake in mistakes}.values())
        super().__init__("\n".join(str(mistake) for mistake in self.mistakes), 2)


def shown(value: Any) -> str:
    """Return a config value as in TOML, shortened to one line."""
    value = list(value) if isinstance(value, tuple) else value
    try:
        text = str(value)
        if isinstance(value, bool):
            text = text.lower()
        elif isinstance(value, str):
            text = f'"{value}"'
    except ValueError:  # Python refuses to print integers of thousands of digits
        text = f"an integer of {value.bit_length()} bits"
    return one_line(text, LONGEST_VALUE)


def one_line(text: str, longest: int) -> str:
    """Return text as one line of at most `longest` characters, without control characters."""
    text = "".join(c if c.isprintable() else "?" for c in " ".join(text[: 2 * longest].split()))
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
