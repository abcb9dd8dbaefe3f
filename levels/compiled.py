"""Small fixed-size algebra as machine code: a Python function that numba compiles at its first use.

A few hundred numpy calls on six numbers were most of a servo cycle: each costs a microsecond, whatever it computes.
A function marked `@compiled` is ordinary numpy code; called directly it runs as such, the reference of its tests.
Alternatives considered: a C extension (users would need a compiler), `jit` at import (numba takes 0.4 s to import, and
most commands compute nothing).

Without `fastmath` the order of operations is the source's, so the bits do not depend on the processor. Compiled code is
kept from run to run. numba itself notices a change in the function, not in those that it calls: so the cache of each
state of the sources has its own folder.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import cache
from hashlib import blake2b
from pathlib import Path
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar

_P = ParamSpec("_P")
_R = TypeVar("_R", covariant=True)


class compiled(Generic[_P, _R]):  # noqa: N801  # a decorator
    """Mark a function for compilation. Arguments are numbers, arrays and records; it may call others marked so."""

    def __init__(self, function: Callable[_P, _R]) -> None:
        self._function = function
        self._machine: Callable[_P, _R] | None = None

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        """Call the function under numpy, and those that it calls: the reference of the compiled one."""
        return self._function(*args, **kwargs)

    def load(self) -> Callable[_P, _R]:
        """Return the compiled function; it is compiled, or read from the cache, at the first call with its types."""
        if self._machine is None:
            self._machine = _jit(self._function)
        return self._machine


def _jit(function: Any) -> Any:
    """Compile a function; those that it calls, if marked, are replaced by their compiled selves."""
    from numba import njit

    _use_cache()
    names, known = function.__code__.co_names, function.__globals__
    called = {name: known[name].load() for name in names if isinstance(known.get(name), compiled)}
    bound = FunctionType(function.__code__, known | called, function.__name__, function.__defaults__)
    bound.__module__, bound.__qualname__ = function.__module__, function.__qualname__
    return njit(cache=True, error_model="numpy")(bound)


@cache
def _use_cache() -> None:
    """Make numba cache its code in a folder for the present sources; remove the folders of earlier ones."""
    import numba

    levels = Path(__file__).parent
    sources = blake2b(digest_size=8)
    for path in sorted(levels.rglob("*.py")):
        sources.update(path.read_bytes())
    here = blake2b(bytes(levels), digest_size=8).hexdigest()
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nasrem-rack"
    folder = home / f"{here}-{sources.hexdigest()}"
    if not folder.exists():
        for old in home.glob(f"{here}-*"):
            shutil.rmtree(old, ignore_errors=True)
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]  # numba makes it from its environment
