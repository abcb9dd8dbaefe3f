"""Regular files of bounded size: everything else is refused, and nothing waits for a FIFO."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from rack.backplane.regular_file import (
    RefusedFileError,
    check_regular_file,
    read_regular_file,
)


@pytest.mark.parametrize("read", [read_regular_file, check_regular_file])
@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("fifo", "not a regular file, but a FIFO"),
        ("link", "not a regular file, but a FIFO"),
        ("device", "not a regular file, but a character device"),
        ("folder", "not a regular file, but a directory"),
        ("socket", "not a regular file, but a socket"),
        ("large", "too large: 9 bytes; the limit is 8"),
    ],
)
def test_only_a_regular_file_of_bounded_size_is_read(
    name: str, why: str, read: Callable[[Path, int], object], tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to("fifo")
    (tmp_path / "device").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    (tmp_path / "large").write_bytes(bytes(9))
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
        with pytest.raises(RefusedFileError) as refusal:
            read(tmp_path / name, 8)
    assert str(refusal.value) == f"{tmp_path / name}: {why}"
    assert refusal.value.strerror == why


def test_a_file_of_the_permitted_size_is_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * 8)
    check_regular_file(path, 8)
    assert read_regular_file(path, 8) == b"x" * 8


def test_the_size_is_bounded_for_a_file_with_a_stated_size_of_zero() -> None:
    path = Path("/proc/self/maps")
    assert path.stat().st_size == 0
    assert len(read_regular_file(path, 1 << 24)) > 100
    with pytest.raises(RefusedFileError, match="too large"):
        read_regular_file(path, 100)


def test_a_fifo_that_takes_the_place_of_a_checked_file_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The path names a regular file while it is checked, and a FIFO when it is opened."""
    file, fifo = tmp_path / "file", tmp_path / "fifo"
    file.write_bytes(b"x")
    os.mkfifo(fifo)
    there = file.stat()
    monkeypatch.setattr(Path, "stat", lambda path: there)
    with pytest.raises(RefusedFileError, match="a FIFO"):
        read_regular_file(fifo, 8)


def test_a_missing_file_is_an_error_of_the_system(tmp_path: Path) -> None:
    for read in (read_regular_file, check_regular_file):
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "none", 8)
