"""Small fixed-size algebra as machine code: a Python function that numba compiles at its first use.

A few hundred numpy calls on six numbers were most of a servo cycle: each costs a microsecond,
whatever it computes. A function marked `@compiled` is ordinary numpy code; called directly it runs
as such, the reference of its tests. Alternatives considered: a C extension (users would need a
compiler), `jit` at import (numba takes 0.4 s to import, and most commands compute nothing).

Without `fastmath` the order of operations is the source's, so the bits do not depend on the
processor. Compiled code is kept from run to run. numba itself notices a change in the function, not
in those that it calls: so the cache of each state of the sources has its own folder.
"""

from __future__ import annotations

import os
import pickle
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import blake2b
from pathlib import Path
from tempfile import TemporaryFile
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar

DIGEST = 16
CURE = "XDG_CACHE_HOME=FOLDER names one that can be written"
_P = ParamSpec("_P")
_R = TypeVar("_R", covariant=True)


class compiled(Generic[_P, _R]):  # noqa: N801  # a decorator
    """Mark a function for compilation. Arguments are numbers, arrays and records; it may call
    others marked so."""

    def __init__(self, function: Callable[_P, _R]) -> None:
        self._function = function
        self._machine: Callable[_P, _R] | None = None

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        """Call the function under numpy, and those that it calls: the reference of the compiled
        one."""
        return self._function(*args, **kwargs)

    def load(self) -> Callable[_P, _R]:
        """Return the compiled function; it is compiled, or read from the cache, at the first call
        with its types."""
        if self._machine is None:
            self._machine = _jit(self._function)
        return self._machine


def _jit(function: Any) -> Any:
    """Compile a function; those that it calls, if marked, are replaced by their compiled selves."""
    from numba import njit

    folder = _use_cache()
    names = function.__code__.co_names
    known = function.__globals__
    called = {name: known[name].load() for name in names if isinstance(known.get(name), compiled)}
    bound = FunctionType(
        function.__code__, known | called, function.__name__, function.__defaults__
    )
    bound.__module__ = function.__module__
    bound.__qualname__ = function.__qualname__
    function = njit(cache=bool(folder), error_model="numpy")(bound)
    if folder:
        _forgive(function._cache)
    else:
        _tell(bound)
    return function


NEWS: list[Callable[[str], object]] = []
"""Called with the name of each function before it is compiled."""


def _forgive(kept: Any) -> None:
    """Let a function do without what is kept of it where that is damaged or cannot be written, and
    say so."""
    load = kept.load_overload
    save = kept.save_overload
    files = kept._cache_file

    def save_sealed(name: str, found: Any) -> None:
        content: bytes = files._dump(found)
        with files._open_for_write(files._data_path(name)) as file:
            file.write(_digest(content) + content)

    def load_sealed(name: str) -> Any:
        sealed = Path(files._data_path(name)).read_bytes()
        # Damaged machine code must never run.
        if _digest(sealed[DIGEST:]) != sealed[:DIGEST]:
            raise ValueError(f"{name} is not what was written")
        return pickle.loads(sealed[DIGEST:])

    def load_or_compile(signature: Any, context: Any) -> Any:
        found = None
        try:
            found = load(signature, context)
        except Exception as error:
            _say(f"{files._index_path}: damaged ({error or type(error).__name__}); compiled again")
            _remove(Path(files._index_path))
        if found is None:
            _tell(kept._py_func)
        return found

    def save_if_possible(signature: Any, data: Any) -> None:
        try:
            save(signature, data)
        except Exception as error:
            _say(f"{kept.cache_path}: compiled code cannot be kept: {error}; {CURE}")

    files._load_data = load_sealed
    files._save_data = save_sealed
    kept.load_overload = load_or_compile
    kept.save_overload = save_if_possible


def _tell(function: FunctionType) -> None:
    for tell in NEWS:
        tell(function.__qualname__)


def _digest(content: bytes) -> bytes:
    return blake2b(content, digest_size=DIGEST).digest()


def _remove(path: Path) -> None:
    with suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


@cache
def _say(text: str) -> None:
    """Print a line, once."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


@cache
def _use_cache() -> str:
    """Make numba cache its code in a folder for the present sources; remove the folders of earlier
    ones.

    Return the folder; an empty text if it cannot be written.
    """
    import numba

    levels = Path(__file__).parent
    sources = blake2b(digest_size=8)
    for path in sorted(levels.rglob("*.py")):
        sources.update(path.read_bytes())
    here = blake2b(bytes(levels), digest_size=8).hexdigest()
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nasrem-rack"
    folder = home / f"{here}-{sources.hexdigest()}"
    try:
        if not folder.exists():
            for old in home.glob(f"{here}-*"):
                shutil.rmtree(old, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        _say(
            f"{folder}: compiled code cannot be kept, and every launch compiles: {error.strerror};"
            f" {CURE}"
        )
        return ""
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]  # numba makes it from its environment
    return str(folder)
