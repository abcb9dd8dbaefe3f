"""Compilation of small fixed-size algebra: numba compiles a marked function at its first use.

A few hundred numpy calls on six numbers took most of a servo cycle: each costs a microsecond,
whatever it computes. A function marked `@compiled` is ordinary numpy code. Called directly, it runs
uncompiled, and tests compare the machine code with it. A function marked `@compiled_for` states its
argument types, so that its machine code can be loaded before a run: see `Executor.preload`.
Alternatives considered: a C extension (users would need a compiler), `jit` at import (numba takes
0.4 s to import, and most commands compute nothing).

Without `fastmath` the order of operations is the order in the source, so the bits do not depend on
the processor. Compiled code is cached from run to run. numba's own cache was rejected: it fails on
a damaged file, runs code with flipped bits, and notices a change of the function itself, but not of
the functions that it calls.
"""

from __future__ import annotations

import ctypes
import errno
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from hashlib import blake2b
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, Generic, ParamSpec, TypeVar

import numpy as np

DIGEST_BYTES = 16
"""Length of a digest, in bytes."""
_P = ParamSpec("_P")
_R = TypeVar("_R", covariant=True)


on_compile: Callable[[str], object] | None = None
"""Called with the name of a function before it is compiled, which takes seconds."""


class compiled(Generic[_P, _R]):  # noqa: N801  # a decorator
    """Decorator that marks a function for compilation.

    The arguments of the function must be numbers, arrays or records. It may call other marked
    functions.
    """

    def __init__(
        self, function: Callable[_P, _R], types: str = "", records: np.dtype[Any] | None = None
    ) -> None:
        self._function = function
        self._types = types
        self._records = records
        self._machine: Callable[_P, _R] | None = None

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        """Call the function, and all marked functions that it calls, as uncompiled Python.

        Tests compare the machine code with this.
        """
        return self._function(*args, **kwargs)

    def load_machine_code(self) -> Callable[_P, _R]:
        """Return the function in its compiled form.

        numba compiles the function, or reads it from the cache, when it is first called with new
        argument types.
        """
        if self._machine is None:
            self._machine = self._build()
        return self._machine

    def _build(self) -> Any:
        """Return this function compiled by numba, with calls to compiled forms of others."""
        from numba import config, njit

        # NUMBA_DISABLE_JIT is meant for users' functions. These functions need compilation, because
        # they call C functions by address.
        # numba creates the attribute at run time.
        config.DISABLE_JIT = 0  # type: ignore[attr-defined]
        function: Any = self._function
        known = function.__globals__
        called = {
            name: known[name].load_machine_code()
            for name in function.__code__.co_names
            if isinstance(known.get(name), compiled)
        }
        bound = FunctionType(
            function.__code__, known | called, function.__name__, function.__defaults__
        )
        bound.__module__ = function.__module__
        bound.__qualname__ = function.__qualname__
        machine = njit(error_model="numpy")(bound)
        name = f"{function.__module__}.{function.__qualname__}"
        # numba creates the attribute at run time.
        machine._cache = _CodeCache(name, _compute_digest(b"".join(self.iterate_source())))  # type: ignore[attr-defined]
        return machine

    def preload(self) -> None:
        """Load the machine code for the types given in `compiled_for`, if any."""
        if self._types:
            from numba import from_dtype
            from numba.core.sigutils import normalize_signature

            machine: Any = self.load_machine_code()
            types, _ = normalize_signature(f"({self._types},)")  # type: ignore[no-untyped-call]
            if self._records is not None:
                types = (from_dtype(self._records)[::1], *types)
            machine.compile(types)

    def iterate_source(self) -> Iterator[bytes]:
        """Yield everything that determines the machine code.

        This includes the instructions, the constants and the values of global names, also for the
        functions that it calls. It excludes comments, docstrings and line numbers.
        """
        function: Any = self._function
        code = function.__code__
        known = function.__globals__
        yield from _iterate_instructions(code, function.__doc__)
        yield repr(function.__defaults__).encode()
        for name in code.co_names:
            # Other names are attributes or builtins.
            if name in known:
                yield name.encode()
                yield from _iterate_value(known[name])


class c_function(compiled[..., Any]):  # noqa: N801  # stands for a function
    """A function of a C library whose arguments are integers: addresses, sizes and flags.

    Compiled code links to it by name, and Python calls it through ctypes. The result is a signed
    word, which is meaningless if the C function returns nothing.
    """

    def __init__(self, library: str, name: str, arguments: int) -> None:
        function = getattr(ctypes.CDLL(library), name)
        function.restype = ctypes.c_ssize_t
        function.argtypes = [ctypes.c_ssize_t] * arguments
        super().__init__(function)
        self._key = name, arguments
        self._library = library

    def iterate_source(self) -> Iterator[bytes]:
        """Yield what determines the machine code of a caller: name and number of arguments."""
        yield repr(self._key).encode()

    def _build(self) -> Any:
        """Load the library and return numba's declaration of the function."""
        from llvmlite import binding
        from numba import types

        binding.load_library_permanently(self._library)
        name, arguments = self._key
        return types.ExternalFunction(name, types.intp(*[types.intp] * arguments))


def compiled_for(
    types: str, records: np.dtype[Any] | None = None
) -> Callable[[Callable[_P, _R]], compiled[_P, _R]]:
    """Return a decorator that marks a function for compilation before a run, for given types.

    Args:
        types: Types as numba writes them: "f8, i8, f8[:, ::1]" are a float, an integer and an array
            in C order.
        records: Type of the records if the first argument is a one-dimensional structured array;
            `types` then lists the other arguments. None if `types` lists all arguments.
    """
    return lambda function: compiled(function, types, records)


def preload(*modules: ModuleType) -> None:
    """Load the machine code of all functions in `modules` that are marked with `compiled_for`."""
    for module in modules:
        for function in [*vars(module).values()]:
            if isinstance(function, compiled):
                function.preload()


class _CodeCache:
    """Cache of the machine code of one function, which numba consults before it compiles.

    Each tuple of argument types has a separate file, which begins with a digest of the code. A file
    is replaced in one step, so that several processes can compile the same function at the same
    time.
    """

    def __init__(self, name: str, source: bytes) -> None:
        self._name = name
        self._source = source.hex()

    def load_overload(self, types: Any, target: Any) -> Any:
        """Return the cached code for these types, or None if it is missing or damaged.

        If the result is None, numba compiles the function.
        """
        from numba.core.compiler import CompileResult

        target.refresh()
        # Without a home folder, or permission to read it, there is no cache.
        with suppress(OSError):
            path = self._build_path(types, target.codegen())
            content = path.read_bytes()
            code = content[DIGEST_BYTES:]
            # Damaged machine code must never run.
            if content[:DIGEST_BYTES] == _compute_digest(code):
                return CompileResult._rebuild(target, *pickle.loads(code))  # type: ignore[no-untyped-call]
            _print_once(f"{path} is damaged; the function is compiled again")
        if on_compile is not None:
            on_compile(self._name)
        return None

    def save_overload(self, types: Any, result: Any) -> None:
        """Save the code for these types and delete code of earlier versions of the function.

        A message is printed if the code cannot be saved.
        """
        from numba.core.serialize import dumps

        if result.library.has_dynamic_globals:
            # The code contains addresses of this process.
            return
        code: bytes = dumps(result._reduce())  # type: ignore[no-untyped-call]
        try:
            path = self._build_path(types, result.codegen)
            partial_file = path.with_name(f"{path.name}.{os.urandom(8).hex()}")
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                partial_file.write_bytes(_compute_digest(code) + code)
                partial_file.replace(path)
            finally:
                partial_file.unlink(missing_ok=True)
            for old in path.parent.glob(f"{self._name}-*"):
                if not old.name.startswith(f"{self._name}-{self._source}-"):
                    old.unlink(missing_ok=True)
        except OSError as error:
            _print_once(
                "compiled code cannot be saved, so every launch compiles it again:"
                f" {error.filename}: {error.strerror}; set XDG_CACHE_HOME to a folder that can be"
                " written"
            )

    def _build_path(self, types: Any, codegen: Any) -> Path:
        """Return the path of the cache file for a tuple of types."""
        from numba import __version__

        build = repr((__version__, sys.version, types, codegen.magic_tuple())).encode()
        return _find_cache_folder() / f"{self._name}-{self._source}-{_compute_digest(build).hex()}"


def _iterate_instructions(code: CodeType, docstring: str | None = None) -> Iterator[bytes]:
    """Yield the bytecode, names and constants of a function, without its docstring."""
    yield code.co_code
    yield repr((code.co_names, code.co_varnames)).encode()
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _iterate_instructions(constant)
        elif constant != docstring:
            yield repr(constant).encode()


def _iterate_value(value: object) -> Iterator[bytes]:
    """Yield a representation of a value that compiled code uses as a constant."""
    match value:
        case compiled():
            yield from value.iterate_source()
        case ModuleType(__name__="math" | "numpy" as name):
            yield name.encode()
        case np.ndarray():
            yield repr((value.dtype, value.shape)).encode() + value.tobytes()
        case bool() | int() | float() | str() | tuple() | np.dtype() | np.generic() | type():
            yield repr(value).encode()
        case _:
            raise TypeError(f"{value!r} cannot be a constant in compiled code")


@cache
def _find_cache_folder() -> Path:
    """Return the cache folder for code that is compiled from this checkout.

    Raises:
        OSError: The user has no home folder.
    """
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nasrem-rack"
    except RuntimeError:
        raise FileNotFoundError(errno.ENOENT, "the user has no home folder", "~") from None
    return home / _compute_digest(bytes(Path(__file__).parent)).hex()


def _compute_digest(content: bytes) -> bytes:
    """Return the BLAKE2 digest of `content`, with `DIGEST_BYTES` bytes."""
    return blake2b(content, digest_size=DIGEST_BYTES).digest()


@cache
def _print_once(text: str) -> None:
    """Print a line to stderr, unless this process has printed it before."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
