"""Checksums of the files of a run, so that damage is reported and never mistaken for data.

`checksums.xxh128` has the format of `xxh128sum -c`. Because a run may be killed at any time, each
line of events.jsonl also contains its own checksum.
"""

from __future__ import annotations

import json
import re
from hashlib import file_digest
from math import nan
from pathlib import Path

from xxhash import xxh3_64_hexdigest, xxh3_128

from rack.backplane.json_text import encode_json
from rack.backplane.regular_file import check_regular_file, read_regular_file
from rack.tools.console.answer import Document, Failure, write_file

CHECKSUMS = "checksums.xxh128"
MAX_READ_BYTES = 1 << 30
"""Size limit for files that are read into memory."""
_MAX_FILE_BYTES = 1 << 40
"""Size limit for any file of a run, bytes."""
_KEY = ', "check": "'
_WHOLE = re.compile(_KEY + r'\w*"}')


def read_file(path: Path) -> bytes:
    """Read a file of a run. Raises `Failure` if it is unreadable or not a regular file."""
    try:
        return read_regular_file(path, MAX_READ_BYTES)
    except OSError as error:
        raise Failure(f"{path}: {error.strerror}", 2) from None


class Checksums:
    """The checksums of a run's files, as stored in `checksums.xxh128`.

    Attributes:
        stored: Dictionary from the path of each file, relative to the folder, to its checksum.
    """

    def __init__(self, folder: Path) -> None:
        self.stored: dict[str, str] = {}
        self._folder = folder
        path = folder / CHECKSUMS
        if path.is_symlink() or path.exists():
            lines = read_file(path).decode(errors="replace").splitlines()
            matches = [re.fullmatch(r"([0-9a-f]{32})  (.+)", line) for line in lines]
            if None in matches:
                raise Failure(f"{path}: line {matches.index(None) + 1} is damaged", 2)
            self.stored = {match[2]: match[1] for match in matches if match}

    def store(self, *patterns: str) -> None:
        """Compute and store the checksums of all regular files that match one of the patterns.

        Raises:
            OSError: The checksums cannot be written.
        """
        for path in (path for pattern in patterns for path in self._folder.glob(pattern)):
            if path.is_file():
                self.stored[str(path.relative_to(self._folder))] = _compute_digest(path)
        text = "".join(f"{value}  {name}\n" for name, value in self.stored.items())
        write_file(self._folder / CHECKSUMS, text)

    def verify(self, *names: str) -> None:
        """Raise `Failure` for the first of these files that differs from its stored checksum."""
        for name in names:
            path = self._folder / name
            if name in self.stored and not path.exists():
                raise Failure(f"{path}: missing, but {CHECKSUMS} lists it", 2)
            if _compute_digest(path) != self.stored.get(name):
                why = f"damaged, or changed later: its checksum differs from {CHECKSUMS}"
                raise Failure(f"{path}: {why}", 2)


def check_file(path: Path) -> None:
    """Raise `Failure` if a file of a run is missing or not a regular file."""
    try:
        check_regular_file(path, _MAX_FILE_BYTES)
    except OSError as error:
        raise Failure(f"{path}: {error.strerror}", 2) from None


def _compute_digest(path: Path) -> str:
    """Return the checksum of a file as hexadecimal digits."""
    check_file(path)
    with path.open("rb") as file:
        return file_digest(file, xxh3_128).hexdigest()


def format_checked_line(entry: Document) -> str:
    """Format an entry of events.jsonl as a line with its own checksum."""
    text = encode_json(entry)
    return f'{text[:-1]}{_KEY}{xxh3_64_hexdigest(text.encode())}"}}\n'


def parse_checked_line(line: str) -> Document:
    """Parse a line of events.jsonl.

    Raises:
        ValueError: The line is damaged or not JSON.
    """
    text, _, check = line.removesuffix("\n").rpartition(_KEY)
    text += "}"
    if check != f'{xxh3_64_hexdigest(text.encode())}"}}':
        raise ValueError("its checksum is wrong")
    entry: Document = json.loads(text)
    if "value" in entry and entry["value"] is None:
        # JSON cannot represent NaN, so it is stored as null.
        entry["value"] = nan
    return entry


def is_cut_off(line: str) -> bool:
    """Return True if a line lacks its checksum, because the run was killed while writing it.

    Call this only for the last line of a file, and only if it does not end with a newline.
    """
    return not _WHOLE.search(line)
