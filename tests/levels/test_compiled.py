"""Compiled code that is kept: damaged, not writable, and who hears that a function is compiled."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

SCRIPT = """
from rack.levels import compiled

@compiled.compiled
def twice(number):
    return number * 2.0

compiled.NEWS.append(print)
print(twice.load()(21.0))
"""
COMPILED, KEPT = ["twice", "42.0"], ["42.0"]


def run(folder: Path) -> tuple[list[str], str]:
    """Return what a process printed that uses the function, and what it said."""
    (folder / "script.py").write_text(SCRIPT)
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, "script.py"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), done.stderr


def as_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGES: dict[str, tuple[str, Callable[[Path], object]]] = {
    "empty index": ("nbi", lambda path: path.write_bytes(b"")),
    "truncated index": ("nbi", lambda path: path.write_bytes(path.read_bytes()[:30])),
    "a folder for an index": ("nbi", as_folder),
    "truncated code": ("nbc", lambda path: path.write_bytes(path.read_bytes()[:100])),
    "one bit of the code": ("nbc", lambda path: path.write_bytes(path.read_bytes()[:-1] + b"\x00")),
}


@pytest.mark.slow
def test_damaged_code_is_compiled_again_and_said(tmp_path: Path) -> None:
    assert run(tmp_path) == (COMPILED, "")
    assert run(tmp_path) == (KEPT, "")
    for name, (kind, damage) in DAMAGES.items():
        (file,) = (tmp_path / "cache").rglob(f"*.{kind}")
        damage(file)
        printed, said = run(tmp_path)
        assert printed == COMPILED, name
        assert "damaged (" in said, name
        assert said.endswith("compiled again\n"), name
        assert run(tmp_path) == (KEPT, ""), name


@pytest.mark.slow
def test_a_cache_that_cannot_be_written_is_said_once_with_its_cure(tmp_path: Path) -> None:
    # A file in place of the folder: not even root can write into it.
    (tmp_path / "cache").write_text("")
    printed, said = run(tmp_path)
    assert printed == COMPILED
    (line,) = said.splitlines()
    assert "compiled code cannot be kept, and every launch compiles" in line
    assert line.endswith("XDG_CACHE_HOME=FOLDER names one that can be written")
    (tmp_path / "cache").unlink()
    shutil.rmtree(tmp_path / "cache", ignore_errors=True)
