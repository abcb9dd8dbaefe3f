"""The viewer's files of a run: run.rrd, and the parts that continue it if the run is long."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count, takewhile
from pathlib import Path

FILE = "run.rrd"


def list_part_names(file: Path) -> Iterator[Path]:
    """Yield a file name, then the names of its possible further parts: run-2.rrd and so on."""
    yield file
    for part in count(2):
        yield file.with_stem(f"{file.stem}-{part}")


def find_next_file(folder: Path) -> Path:
    """Return the next unused name of a part in the folder of a run.

    Thus a restarted recorder does not overwrite the parts of its predecessor.
    """
    return next(path for path in list_part_names(folder / FILE) if not path.is_file())


def list_parts(file: Path) -> list[Path]:
    """Return the existing parts of the recording that begins with `file`, oldest first."""
    return [*takewhile(Path.is_file, list_part_names(file))]
