"""Prints the answers of commands, and ends a command that fails."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from typing import IO, Any, NoReturn

from rack.backplane.json_text import encode_json
from rack.boards.errors import Failure as Failure
from rack.boards.errors import to_one_line

Document = dict[str, Any]
"""Plain data, as `--json` prints it and as the files of a run store it."""
MAX_LINE = 1300
"""Maximum number of characters in one line of an error message."""
PIPE_WIDTH = 100
"""Maximum number of columns of text, unless stdout is a terminal. Longer words are not broken."""


@contextmanager
def convert_errors() -> Iterator[None]:
    """Convert errors of the backplane and the levels to `Failure`."""
    try:
        yield
    except Exception as error:
        from rack.backplane.errors import BackplaneError
        from rack.levels.errors import LevelError

        if isinstance(error, BackplaneError | LevelError):
            raise Failure(str(error)) from None
        raise


def write_file(path: Path, text: str) -> None:
    """Write a file under a temporary name, and rename it over any existing file or link."""
    unfinished = path.with_name(f"{path.name}.unfinished")
    unfinished.unlink(missing_ok=True)
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)


def write_json(path: Path, document: Any) -> None:
    """Write a document as JSON with `write_file`."""
    write_file(path, encode_json(document, indent=2) + "\n")


def print_json(document: Any) -> None:
    """Print a document as the answer to `--json`."""
    print(encode_json(document, indent=2))


def print_answer(document: Any, text: str | Iterable[str], as_json: bool) -> None:
    """Print the answer of a command.

    Args:
        document: The answer as plain data.
        text: The answer as readable text, whole or as lines.
        as_json: True to print the document, and nothing else.
    """
    if as_json:
        print_json(document)
    else:
        print_text(text.split("\n") if isinstance(text, str) else text)


def print_text(lines: Iterable[str], stream: IO[str] | None = None) -> None:
    """Print lines of text. A pipe gets no wide lines, and wrapped commands remain executable.

    Args:
        lines: The lines.
        stream: Where to print them. None for stdout.
    """
    stream = stream or sys.stdout
    for line in lines:
        if len(line) > PIPE_WIDTH and not stream.isatty():
            line = fill(
                line,
                PIPE_WIDTH - 2,
                subsequent_indent=" " * (len(line) - len(line.lstrip()) + 2),
                break_long_words=False,
                break_on_hyphens=False,
            )
            if line.startswith(("  rack ", "  --set ")):
                line = line.replace("\n", " \\\n")
        print(line, file=stream, flush=True)


def exit_with_failure(reason: str, status: int) -> NoReturn:
    """Print the reason on stderr, with --json also as JSON on stdout, and exit with `status`."""
    lines = [
        line if line.isprintable() and len(line) <= MAX_LINE else to_one_line(line, MAX_LINE)
        for line in reason.splitlines()
    ]
    print(*lines, sep="\n", file=sys.stderr)
    if "--json" in sys.argv[1:]:
        print_json({"error": lines})
    sys.exit(status)
