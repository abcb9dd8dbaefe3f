"""What a process of the rack consists of, and what of it has changed since it was built.

A process is built from its wiring, in the run of a checkpoint as in the run that continues it: the
same objects, found by the same walk in the same order. So a checkpoint holds no models, configs,
functions, views of shared memory or descriptors. It holds the contents that have changed, each
under its place in the walk, and whole only those objects that were made since. Contents are put
back in place, so whoever shared them, or had a view of them, still does.

What a level's constructor computed, and nothing has changed since, is not in a checkpoint: on a
branch with other parameters the new ones count.

Alternatives considered: each task pickled whole (views of MuJoCo's memory and of the segment come
back as copies; a Python call for each object, to find them, takes 300 ms), and a restart of all
boards on a copy of the segment (a restart stops the arm, and planners hold what is in no message).
"""

from __future__ import annotations

import io
import pickle
import sys
from collections.abc import Collection, Mapping
from hashlib import blake2b
from pathlib import Path
from types import MethodType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rack.boards.checkpoint.kinds import ATOMS, Elements, ObjectState, changes, part_kind
from rack.boards.errors import CheckpointError

_T = TypeVar("_T")
FLOORS = ("rack.backplane.", "rack.boards.", "rack.levels.")
PERMITTED = {
    ("collections", "deque"),
    ("functools", "partial"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
}
"""What a checkpoint may name besides what is the rack's or the config's."""
UNPICKLABLE = (TypeError, AttributeError, pickle.PicklingError, CheckpointError)
"""What a pickler raises."""

VIEWS = (np.ndarray, np.void, memoryview)


class Parts:
    """The parts of one process, found from `root` down once it has been built.

    `shape` stands for their types, attributes and sizes. Raises `CheckpointError` for one of an
    unknown kind.
    """

    def __init__(self, root: object, name: str) -> None:
        self._all: list[Any] = []
        self._places: list[str] = []
        self._numbers: dict[int, tuple[int, object]] = {}
        self._before: dict[int, Any] = {}
        shape = blake2b(digest_size=16)
        self._note(root, name)
        for number, thing in enumerate(self._all):  # it grows meanwhile
            place = self._places[number]
            kind = type(thing)
            try:
                known = part_kind(kind)
            except CheckpointError as error:
                raise CheckpointError(f"{place}: {error}") from None
            for key, inner in known.inner(thing):
                self._note(inner, f"{place}.{key}")
            contents = None if known.contents is None else known.contents(thing)
            if contents is not None:
                self._before[number] = contents
            shape.update(f"{kind.__module__}.{kind.__qualname__} {_form(contents)} ".encode())
        self.shape = shape.hexdigest()
        # Copied for each pickler: filling a memo from a dictionary takes a millisecond.
        self._memo = pickle.Pickler(io.BytesIO())
        self._memo.memo = self._numbers  # as the C code has it

    def _note(self, thing: Any, place: str) -> None:
        if not isinstance(thing, ATOMS) and id(thing) not in self._numbers:
            self._numbers[id(thing)] = len(self._all), thing
            self._all.append(thing)
            self._places.append(place)

    def number(self, thing: object) -> int:
        """Return the place of a part in the walk; -1 for what was made since."""
        return self._numbers.get(id(thing), (-1, None))[0]

    def changed(self) -> dict[int, Any]:
        """Return what has changed since in each part, by its number, as `kinds.changes` does."""
        changed = {}
        for number, before in self._before.items():
            thing = self._all[number]
            kind = part_kind(type(thing))
            if kind.is_same is not None and kind.is_same(thing, before):
                continue
            assert kind.contents is not None, "it had some before"
            if (found := changes(kind.contents(thing), before)) is not None:
                changed[number] = found
        return changed

    def save(self) -> bytes:
        """Return what has changed since. Raises `CheckpointError` for what cannot be kept."""
        changed = self.changed()
        try:
            return self._pickled(changed)
        except UNPICKLABLE as error:
            raise CheckpointError(self._blame(changed, error)) from None

    def _pickled(self, found: Any) -> bytes:
        file = io.BytesIO()
        pickler = pickle.Pickler(file, pickle.HIGHEST_PROTOCOL)
        # The pickler takes the parts for written already, and refers to them by number: no Python
        # is called for each object.
        pickler.memo = self._memo.memo
        pickler.dispatch_table = {np.ndarray: self._array}
        pickler.dump(found)
        return file.getvalue()

    def _blame(self, changed: Mapping[int, Any], error: Exception) -> str:
        """Name the part that holds what cannot be kept."""
        for number, found in changed.items():
            try:
                self._pickled(found)
            except UNPICKLABLE:
                return f"{self._places[number]}: {error}"
        return str(error)

    def _array(self, array: NDArray[Any]) -> Any:
        """Reduce an array made since: a view of a part's memory stays one."""
        owner = array.base
        while id(owner) not in self._numbers and isinstance(owner, VIEWS):
            owner = owner.obj if isinstance(owner, memoryview) else owner.base
        if id(owner) in self._numbers:
            first = np.frombuffer(owner, np.uint8).ctypes.data  # type: ignore[arg-type]
            at = array.ctypes.data - first
            return _viewed, (owner, array.shape, array.dtype, at, array.strides)
        if owner is None or isinstance(owner, bytes | bytearray):
            return array.__reduce_ex__(pickle.HIGHEST_PROTOCOL)
        raise CheckpointError(f"a view of the memory of a {type(owner).__name__}")

    def load(self, saved: bytes, packages: Collection[Path]) -> None:
        """Put what `save` returned in another process into the parts of this one.

        Classes may be those of the rack, and of modules in `packages`. Raises `CheckpointError`.
        """
        unpickler = _Unpickler(io.BytesIO(_memo_of(len(self._all)) + saved), packages, self._all)
        try:
            unpickler.load()
            for number, found in unpickler.load().items():
                put = part_kind(type(self._all[number])).put
                assert put is not None, "it has contents"
                put(self._all[number], found)
        except CheckpointError:
            raise
        except Exception as error:
            raise CheckpointError(f"its state does not fit: {error!r}") from None

    def of_type(self, kind: type[_T]) -> list[_T]:
        """Return the parts of that type."""
        return [thing for thing in self._all if isinstance(thing, kind)]


def _form(contents: Any) -> str:
    """Return what must be the same of contents: names of attributes, size of an array; a list may
    have any length."""
    match contents:
        case ObjectState(named):
            return " ".join(named)
        case Elements():
            return str(len(contents.raw))
        case _:
            return ""


def _memo_of(count: int) -> bytes:
    """Return a pickle that fills an unpickler's memo with the parts by their numbers: what is
    assigned to `memo` is lost (CPython 3.11)."""
    each = (b"".join((b"J", number.to_bytes(4, "little"), b"Q\x940")) for number in range(count))
    return b"".join((b"\x80\x05", *each, b"N."))


class _Unpickler(pickle.Unpickler):
    """Makes objects of the rack's classes, of those of the config's packages, and of a few more: a
    checkpoint comes from a file."""

    def __init__(self, file: io.BytesIO, packages: Collection[Path], parts: list[Any]) -> None:
        super().__init__(file)
        self._packages = packages
        self._parts = parts

    def persistent_load(self, number: int) -> Any:
        """Return a part."""
        return self._parts[number]

    def find_class(self, module: str, name: str) -> Any:
        """Return what a checkpoint may name. Raises `CheckpointError`."""
        if (module, name) == ("builtins", "getattr"):
            return _method
        if (module, name) in PERMITTED:
            return super().find_class(module, name)
        found = super().find_class(module, name) if self._is_ours(module) else None
        # Not what a module has merely imported.
        if found is None or not self._is_ours(getattr(found, "__module__", "")):
            raise CheckpointError(f"it names {module}.{name}, which no checkpoint needs")
        return found

    def _is_ours(self, module: str) -> bool:
        """Say whether a module is the rack's, or was loaded from the config's packages."""
        place = getattr(sys.modules.get(module), "__file__", None)
        return module.startswith(FLOORS) or (
            place is not None and any(Path(place).is_relative_to(p) for p in self._packages)
        )


def _method(owner: object, name: str) -> Any:
    """Return a method of an object: bound methods are pickled as a call of `getattr`, which could
    reach anything."""
    found = None if name.startswith("__") else getattr(owner, name)
    if not isinstance(found, MethodType) or isinstance(owner, type):
        raise CheckpointError(f"it names '{name}' of a {type(owner).__name__}: no method")
    return found


def _viewed(owner: Any, shape: Any, kind: np.dtype, at: int, strides: Any) -> NDArray[Any]:
    """Return a view of the memory of a part."""
    return np.ndarray(shape, kind, owner, at, strides)
