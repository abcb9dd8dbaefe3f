"""Compiled code that is kept: what it is compiled from, damaged, not writable, and reported."""

from __future__ import annotations

import os
import string
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from rack.levels import compiled as module
from rack.levels.compiled import compiled
from tests.processes import exit_status, fork

SCALE = 3.0
Captured = pytest.CaptureFixture[str]


def twice(value: float) -> float:
    return 2.0 * value


def scaled(value: float) -> float:
    return SCALE * value


@pytest.fixture(autouse=True)
def names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of the functions compiled, in a cache of this test's own."""
    names: list[str] = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "on_compile", names.append)
    module._find_cache_folder.cache_clear()
    module._print_once.cache_clear()
    yield names
    module._find_cache_folder.cache_clear()
    module._print_once.cache_clear()


def call_fresh(function: Callable[[float], float] = twice, value: float = 1.5) -> float:
    """Call a compiled function as a process does that has not used it yet."""
    return compiled(function).load_machine_code()(value)


def list_files(tmp_path: Path) -> list[Path]:
    """Return the files, or what is in their places."""
    return sorted((tmp_path / "cache" / "nasrem-rack").glob("*/*"))


@pytest.mark.slow
def test_code_is_compiled_once_per_types(names: list[str], tmp_path: Path) -> None:
    assert [call_fresh(), call_fresh()] == [3.0, 3.0]
    assert names == ["tests.levels.test_compiled.twice"]
    assert call_fresh(value=np.int64(2)) == 4.0
    assert call_fresh(scaled) == 4.5
    assert len(names) == len(list_files(tmp_path)) == 3


SOURCE = string.Template('''
FACTOR = $factor

@compiled
def inner(value):
    """$docstring"""
    return $inner

@compiled
def outer(value):
    # $comment
    return FACTOR * inner(value)
''')
AS_IT_IS = {"factor": "2.0", "docstring": "Add.", "inner": "value + 1.0", "comment": "Both."}


def build_outer(**changes: str) -> compiled[[float], float]:
    """Return a function that uses a constant and calls another one, with changes in its source."""
    text = SOURCE.substitute(AS_IT_IS | changes)
    names: dict[str, compiled[[float], float]] = {"compiled": compiled}  # type: ignore[dict-item]
    exec(compile(text, "outer.py", "exec"), names | {"__name__": "theirs"}, names)
    outer = names["outer"]
    # Globals of a module, not the locals of this call.
    outer._function.__globals__.update(names)
    return outer


@pytest.mark.slow
def test_code_is_recompiled_if_its_source_changes(names: list[str], tmp_path: Path) -> None:
    assert build_outer().load_machine_code()(1.0) == 4.0
    assert names == ["theirs.outer", "theirs.inner"]
    before = list_files(tmp_path)
    for same in ({"docstring": "Sum."}, {"comment": "Twice.\n\n"}):
        assert build_outer(**same).load_machine_code()(1.0) == 4.0
    assert (len(names), list_files(tmp_path)) == (2, before)
    assert build_outer(inner="value + 2.0").load_machine_code()(1.0) == 6.0
    assert names[2:] == ["theirs.outer", "theirs.inner"]
    assert build_outer(inner="value + 2.0", factor="3.0").load_machine_code()(1.0) == 9.0
    # The called one is the same.
    assert names[4:] == ["theirs.outer"]
    # And none of an earlier state stays.
    assert len(list_files(tmp_path)) == 2


@pytest.mark.parametrize("value", ["object()", "[1.0]", "__import__('random')"])
def test_a_global_that_may_change_unnoticed_is_refused(value: str) -> None:
    with pytest.raises(TypeError, match="cannot be a constant in compiled code"):
        build_outer(factor=value).load_machine_code()


def truncate_file(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def flip_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.slow
@pytest.mark.parametrize("damage", [truncate_file, flip_bit])
def test_damaged_code_is_reported_and_compiled_again(
    damage: Callable[[Path], None], names: list[str], tmp_path: Path, capsys: Captured
) -> None:
    call_fresh()
    (file,) = list_files(tmp_path)
    damage(file)
    assert call_fresh() == 3.0
    assert capsys.readouterr().err == f"{file} is damaged; the function is compiled again\n"
    assert call_fresh() == 3.0
    assert len(names) == 2
    assert list_files(tmp_path) == [file]
    assert file.is_file()


@pytest.mark.slow
@pytest.mark.parametrize("is_readable", [True, False])
def test_without_a_home_code_is_compiled_in_memory(is_readable: bool, tmp_path: Path) -> None:
    """A user without a home, and one whose HOME is another user's, as after `setpriv`."""

    def call() -> bool:
        os.environ.pop("XDG_CACHE_HOME")
        os.environ.pop("HOME")
        if not is_readable:
            os.environ["HOME"] = str(tmp_path)
        tmp_path.chmod(0o700)
        os.setuid(65_533)
        return [call_fresh(), call_fresh()] == [3.0, 3.0]

    if os.getuid() != 0:
        pytest.skip("only root can become another user")
    assert exit_status(fork(call), 60.0) == 0


@pytest.mark.slow
@pytest.mark.parametrize("place", ["cache", "cache/nasrem-rack"])
def test_an_unwritable_cache_is_reported_once_with_a_remedy(
    place: str, names: list[str], tmp_path: Path, capsys: Captured
) -> None:
    # A file in place of a folder: not even root can write into it.
    file = tmp_path / place
    file.parent.mkdir(exist_ok=True)
    file.touch()
    assert [call_fresh(), call_fresh(), call_fresh(scaled)] == [3.0, 3.0, 4.5]
    (line,) = capsys.readouterr().err.splitlines()
    assert "compiled code cannot be saved, so every launch compiles it again: " in line
    assert line.endswith("set XDG_CACHE_HOME to a folder that can be written")
    assert len(names) == 3
