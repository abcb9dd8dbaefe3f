"""Instructions and C functions that Python does not have, for compiled code.

The instructions are atomic loads and stores, and fences. LLVM translates them for the processor at
hand. On x86-64 they become ordinary loads and stores, which that processor does not reorder. On
others LLVM adds barriers. Addresses must be aligned to 8 bytes. The instructions work only in
compiled code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
from xxhash import _xxhash  # type: ignore[attr-defined]  # the module with the C functions

from rack.levels.compiled import c_function, compiled


class instruction(compiled[..., Any]):  # noqa: N801  # a decorator
    """Decorator that makes a function callable in compiled code by emitting LLVM instructions.

    The decorated function is called once, at compile time, with LLVM's builder and the arguments,
    which are 64-bit words. It returns the result: a word or, if `record` is given, a pointer to a
    record of that type. None represents the word 0.
    """

    def __init__(self, emit: Callable[..., Any], record: np.dtype | None = None) -> None:
        super().__init__(emit)
        self._record = record

    def iterate_source(self) -> Iterator[bytes]:
        """Yield what determines the machine code of a caller: this file and the record type."""
        yield Path(__file__).read_bytes()
        yield repr(self._record).encode()

    def _build(self) -> Any:
        """Build the numba intrinsic that emits the instructions."""
        from numba import from_dtype, types
        from numba.extending import intrinsic

        emit = self._function
        kind: Any = from_dtype(self._record) if self._record else types.int64

        def define(context: Any, *arguments: Any) -> Any:
            """Return the numba signature of the function and the code generator for it."""

            def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                """Emit the instructions, and convert the result to the declared type."""
                result = emit(builder, *values) or context.get_constant(types.int64, 0)
                return builder.bitcast(result, context.get_value_type(kind))

            return kind(*arguments), lower

        # numba asks for the number of arguments.
        define.__signature__ = signature(emit)  # type: ignore[attr-defined]
        return intrinsic(define)


def to_pointer(builder: Any, address: Any) -> Any:
    """Emit the conversion of an address to a pointer to a 64-bit word."""
    from llvmlite import ir

    return builder.inttoptr(address, ir.IntType(64).as_pointer())


@instruction
def load(builder: Any, address: Any) -> Any:
    """Load the word at an address atomically. No later access is moved before the load."""
    return builder.load_atomic(to_pointer(builder, address), "acquire", 8)


@instruction
def store_release(builder: Any, address: Any, value: Any) -> None:
    """Store a word at an address atomically. No earlier access is moved after the store."""
    builder.store_atomic(value, to_pointer(builder, address), "release", 8)


@instruction
def fence(builder: Any) -> None:
    """Prevent reordering of accesses across the fence, except of a store with a later load."""
    builder.fence("acq_rel")


copy = c_function("libc.so.6", "memcpy", 3)
"""C function that copies memory. Its arguments are target, source and size in bytes."""
xxh3 = c_function(_xxhash.__file__, "XXH3_64bits_withSeed", 3)
"""C function that computes a checksum from address, size in bytes and seed.

Python's `xxhash` calls the same function.
"""
