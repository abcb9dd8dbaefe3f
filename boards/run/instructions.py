"""Instructions and C functions that Python does not have, for compiled code: atomic loads and
stores, fences, copies between addresses.

LLVM makes of them what the processor needs: on x86-64 ordinary loads and stores, which it does not
reorder, on others barriers. Each is aligned to 8 bytes. They work in compiled code alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from inspect import Parameter, Signature
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from xxhash import _xxhash  # type: ignore[attr-defined]  # the module with the C functions

from rack.levels.compiled import compiled

_P = ParamSpec("_P")
_R = TypeVar("_R")


class linked(compiled[_P, _R]):  # noqa: N801  # a decorator
    """Mark a function that returns what compiled code calls under its name: an instruction, or a
    function of a C library. `key`: what else it depends on than this file.
    """

    def __init__(self, make: Callable[_P, _R], key: str = "") -> None:
        super().__init__(make)
        self._key = key

    def source(self) -> Iterator[bytes]:
        """Yield what a caller's code depends on."""
        yield Path(__file__).read_bytes()
        yield self._key.encode()

    def load(self) -> Any:
        """Return it, for compiled callers."""
        if self._machine is None:
            make: Any = self._function
            self._machine = make()
        return self._machine


def _instruction(emit: Callable[..., Any], count: int, result: Any = None) -> Any:
    """Return what compiles to the instructions that `emit` builds.

    Args:
        emit: Called with LLVM's builder and the arguments, which are words.
        count: Number of arguments.
        result: numba's type of the result; by default a word.
    """
    from numba import types
    from numba.extending import intrinsic

    def instruction(context: Any, *arguments: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            made = emit(builder, *values)
            return context.get_constant(types.int64, 0) if made is None else made

        return (result or types.int64)(*[types.int64] * count), build

    names = [Parameter(f"argument{at}", Parameter.POSITIONAL_ONLY) for at in range(count + 1)]
    instruction.__signature__ = Signature(names)  # type: ignore[attr-defined]  # numba asks for it
    return intrinsic(instruction)


def _pointer(builder: Any, address: Any) -> Any:
    from llvmlite import ir

    return builder.inttoptr(address, ir.IntType(64).as_pointer())


@linked
def load(*_: int) -> Any:
    """Load the word at an address, whole; no later access comes before."""
    return _instruction(lambda b, at: b.load_atomic(_pointer(b, at), "acquire", 8), 1)


@linked
def store_release(*_: int) -> Any:
    """Store at an address a word; no earlier access comes after."""

    def emit(builder: Any, address: Any, value: Any) -> None:
        builder.store_atomic(value, _pointer(builder, address), "release", 8)

    return _instruction(emit, 2)


@linked
def fence(*_: int) -> Any:
    """Keep accesses before and after it apart, but for a store before and a load after."""

    def emit(builder: Any) -> None:
        builder.fence("acq_rel")

    return _instruction(emit, 0)


@linked
def copy(*_: int) -> Any:
    """Copy to an address, from an address, so many bytes."""

    def emit(builder: Any, to: Any, source: Any, size: Any) -> None:
        from numba.core.cgutils import raw_memcpy

        ends = _pointer(builder, to), _pointer(builder, source)
        raw_memcpy(builder, *ends, size, 1)  # type: ignore[no-untyped-call]

    return _instruction(emit, 3)


def record_at(dtype: np.dtype) -> linked[..., Any]:
    """Return a function that gives compiled code the record of a type at an address."""

    def make(*_: int) -> Any:
        from llvmlite import ir
        from numba import from_dtype

        place = ir.ArrayType(ir.IntType(8), dtype.itemsize).as_pointer()
        return _instruction(lambda b, at: b.inttoptr(at, place), 1, from_dtype(dtype))

    return linked(make, repr(dtype))


@linked
def xxh3(*_: int) -> Any:
    """Return the checksum of the bytes at an address, so many, with a seed: by the C function that
    the Python classes call.
    """
    from llvmlite import binding
    from numba import types

    binding.load_library_permanently(_xxhash.__file__)
    word = types.int64
    return types.ExternalFunction("XXH3_64bits_withSeed", word(word, word, word))
