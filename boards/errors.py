"""Exceptions of the boards, with the cause of each.

`BoardError` is the root. Catching it catches every error that this package raises on purpose.

- `ConfigError`: a config contains mistakes. It reports all of them, before any process starts.
- `LaunchError`: a board did not start, because its self-test failed or it was not ready in time.
- `SnapshotError`: a process cannot be copied, or a rack cannot continue from a snapshot.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

MAX_VALUE_LENGTH = 80
MAX_PLACE_LENGTH = 120
MAX_REASON_LENGTH = 1000
UNRECOVERABLE_STATUS = 4
"""Exit status of a board whose failure would occur again after a restart."""

NO_SNAPSHOTS_PREFIX = "no snapshots: "
"""Prefix of the message that a run takes no snapshots. The reason follows."""


class Failure(Exception):
    """Raised if a `rack` command, or the same action called from a program, has failed.

    Args:
        reason: Message for the user.
        status: Exit status of the command.
    """

    def __init__(self, reason: str, status: int = 1) -> None:
        super().__init__(reason)
        self.status = status


class BoardError(Failure):
    """Root of all errors of this package. Its text is one line for the user."""


class LaunchError(BoardError):
    """Raised if a rack with a correct config cannot be launched."""


class SnapshotError(BoardError):
    """Raised if a process cannot be copied, or a rack cannot continue from a snapshot."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason, 2)


@dataclass(frozen=True)
class Mistake:
    """One mistake in a config.

    Attributes:
        place: Config key at which the mistake was found.
        value: Value of the key. None if it has no value to show.
        why: Reason why this is a mistake, or the permitted values.
    """

    place: str
    value: Any
    why: str

    def __str__(self) -> str:
        """Return the mistake as one line."""
        value = "" if self.value is None else f" = {format_value(self.value)}"
        return (
            f"{to_one_line(self.place, MAX_PLACE_LENGTH)}{value}: "
            f"{to_one_line(self.why, MAX_REASON_LENGTH)}"
        )


Mistakes = Iterator[Mistake]
"""Result type of a function that checks one rule for configs."""


class ConfigError(BoardError):
    """Raised for a config that cannot run.

    `mistakes` contains every mistake found, and the text has one line per mistake.
    """

    def __init__(self, mistakes: Iterable[Mistake]) -> None:
        self.mistakes = list({str(mistake): mistake for mistake in mistakes}.values())
        super().__init__("\n".join(str(mistake) for mistake in self.mistakes), 2)


def format_value(value: Any) -> str:
    """Format a config value as in TOML, on one line and shortened if it is long."""
    value = list(value) if isinstance(value, tuple) else value
    try:
        text = str(value)
        if isinstance(value, bool):
            text = text.lower()
        elif isinstance(value, str):
            text = f'"{value}"'
    except ValueError:  # Python refuses to print integers of thousands of digits
        text = f"an integer of {value.bit_length()} bits"
    return to_one_line(text, MAX_VALUE_LENGTH)


def to_one_line(text: str, longest: int) -> str:
    """Return a text on one line, cut to `longest` characters, with control characters replaced."""
    text = "".join(c if c.isprintable() else "?" for c in " ".join(text[: 2 * longest].split()))
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
