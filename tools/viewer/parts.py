"""The viewer's files of a run: run.rrd, and of a long one the parts that continue it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count, takewhile
from pathlib import Path

FILE = "run.rrd"


def names(file: Path) -> Iterator[Path]:
    """Yield the names of a file and its parts: run.rrd, run-2.rrd and so on, without an end."""
    yield file
    for part in count(2):
        yield file.with_stem(f"{file.stem}-{part}")


def next_file(folder: Path) -> Path:
    """Return the file to write; a restarted recorder overwrites none."""
    return next(path for path in names(folder / FILE) if not path.is_file())


def parts_of(file: Path) -> list[Path]:
    """Return the parts that there are, oldest first."""
    return [*takewhile(Path.is_file, names(file))]
