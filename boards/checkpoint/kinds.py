"""Kinds of objects that the processes of a rack consist of: what each leads to, what of it may
change, and how that is put back.

`KINDS` is the list of what the state of a process is. An object of another kind has no checkpoint,
and says so by name; variables of modules and classes are in none.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from ctypes import Array as CArray
from dataclasses import fields, is_dataclass
from dis import opmap
from enum import Enum
from functools import _lru_cache_wrapper, partial
from gc import get_referents
from itertools import chain
from mmap import mmap
from operator import is_
from pathlib import PurePath
from struct import Struct
from types import (
    BuiltinFunctionType,
    CellType,
    CodeType,
    FunctionType,
    MappingProxyType,
    MethodType,
    MethodWrapperType,
    ModuleType,
)
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel

from rack.backplane.byte_lock import ByteLock
from rack.backplane.fault_table import FaultEntry
from rack.backplane.layout import Layout, MailboxSpec, TaskSpec
from rack.backplane.operator_table import RequestEntry
from rack.backplane.segment import Segment
from rack.backplane.semaphores import Semaphore
from rack.boards.errors import CheckpointError
from rack.boards.wiring import Keeping
from rack.levels.compiled import compiled
from rack.levels.level import LevelContext

Inner = Iterable[tuple[object, Any]]
"""What a thing leads to, by key or place, in the same order in every process."""
ATOMS = (int, float, complex, str, bytes, frozenset, type(None), np.number, np.bool_)
"""What cannot change, and is written where it stands."""
FOUND_AGAIN = "found_again"
"""Attribute of a class: the names of those that its objects find again where they are not set."""
_ABSENT = object()
_WORD = np.dtype(np.uint64)


class Keeper:
    """Base of what saves a process: it hangs on its parts, and is none of them."""


def nothing(thing: Any) -> Inner:
    """Return that a thing leads to nothing."""
    return ()


class PartKind(NamedTuple):
    """One kind. `types`: its types, or names of types, of libraries that not every rack loads.

    `contents` returns a copy of what may change (None: nothing), `put` puts what `changes` found
    back. `is_same` says of a thing, sooner than that, whether it is as in contents of before; where
    it denies it, the contents tell.
    """

    name: str
    types: tuple[type | str, ...]
    inner: Callable[[Any], Inner] = nothing
    contents: Callable[[Any], Any] | None = None
    put: Callable[[Any, Any], None] | None = None
    is_same: Callable[[Any, Any], bool] | None = None


def _put_dict(thing: dict[Any, Any], found: list[Any]) -> None:
    half = len(found) // 2
    thing.clear()
    thing.update(zip(found[:half], found[half:], strict=True))


def _put_list(thing: list[Any] | deque[Any], found: list[Any]) -> None:
    thing.clear()
    thing.extend(found)


def _put_set(thing: set[Any], found: list[Any]) -> None:
    thing.clear()
    thing.update(found)


def _put_cell(thing: CellType, found: list[Any]) -> None:
    (thing.cell_contents,) = found


def _put_bytes(thing: bytearray, found: bytes) -> None:
    thing[:] = found


class Elements(NamedTuple):
    """The contents of an array: `raw` in its own order, elements of `size` bytes."""

    raw: bytes
    size: int


def _elements(thing: np.ndarray) -> Elements | None:
    """Return the elements of an array; None for a view: they are its owner's."""
    if thing.base is not None or not thing.flags.writeable:
        return None
    return Elements(thing.tobytes("A"), thing.itemsize)


def _flat(thing: np.ndarray) -> np.ndarray:
    return thing.reshape(-1, order="A").view(f"V{thing.itemsize}")


def _put_array(thing: np.ndarray, found: tuple[bytes, bytes]) -> None:
    places, elements = found
    flat = _flat(thing)
    flat[np.frombuffer(places, np.int32)] = np.frombuffer(elements, flat.dtype)


def _data(thing: Any) -> tuple[bytes, int, bytes, bytes, bytes]:
    """Return all of a MjData but the model that its state carries along: what is before that; of
    what is after it the number of words, and, as most are 0, the places and values of the others;
    and the bytes that are left."""
    state: bytes = thing.__getstate__()
    before, after = state.split(thing.model.__getstate__(), 1)
    words = np.frombuffer(after, _WORD, len(after) // _WORD.itemsize)
    places = np.flatnonzero(words != 0)
    rest = after[words.nbytes :]
    return before, words.size, places.astype(np.int32).tobytes(), words[places].tobytes(), rest


def _put_data(thing: Any, found: tuple[bytes, int, bytes, bytes, bytes]) -> None:
    """Put a MjData back where it is, since others know its addresses."""
    import mujoco

    from rack.levels.robot.engine import mj_update_sleep

    before, size, places, values, rest = found
    words = np.zeros(size, _WORD)
    words[np.frombuffer(places, np.int32)] = np.frombuffer(values, _WORD)
    source = mujoco.MjData.__new__(mujoco.MjData)
    source.__setstate__(b"".join((before, thing.model.__getstate__(), words.tobytes(), rest)))
    mujoco.mj_copyData(thing, thing.model, source)
    if (thing.tree_asleep >= 0).any():
        # The state has who sleeps, but not how many are awake.
        mj_update_sleep(thing.model._address, thing._address)


class ObjectState(NamedTuple):
    """The attributes of an object by name; and, unless it has a dictionary of them, all that it
    refers to: their values, in an order of their own, and its class."""

    named: dict[str, Any]
    referents: list[Any]


def _fields(names: tuple[str, ...], again: tuple[str, ...], thing: Any) -> ObjectState:
    """Return the attributes of an object: those in `names`, if what it refers to shows that these
    are all, else those in its dictionary.

    Before Python 3.13 a look at `__dict__` makes that dictionary, for good, and every access to an
    attribute then takes twice as long: a tenth of all processor time of a rack.
    """
    values = ((name, getattr(thing, name, _ABSENT)) for name in names)
    named = {name: value for name, value in values if value is not _ABSENT}
    found = get_referents(thing)
    if len(found) != len(named) + 1 or not {*map(id, found)}.issuperset(map(id, named.values())):
        named = dict(sorted((named | getattr(thing, "__dict__", {})).items()))
        found = []
    for name in again:
        named.pop(name, None)
    return ObjectState(named, found)


def _has_same_fields(thing: Any, before: ObjectState) -> bool:
    """Say whether an object has the attributes of before, without a look at each, by what it refers
    to. One that was deleted, while another one was set to the same object, does not show."""
    now = get_referents(thing)
    return len(now) == len(before.referents) and all(map(is_, now, before.referents))


def _names(kind: type) -> tuple[str, ...]:
    """Return the names of the slots of a class, and of other attributes that its methods set."""
    bases = [vars(base) for base in kind.__mro__]
    slots = [base["__slots__"] for base in bases if "__slots__" in base]
    found = {name for names in slots for name in ([names] if isinstance(names, str) else names)}
    if not hasattr(kind, "__getattr__"):
        values = (value for base in bases for value in base.values())
        codes = (value.__code__ for value in values if isinstance(value, FunctionType))
        # What a class has by that name an object need not have set.
        found |= {name for code in codes for name in _set_in(code)} - {*chain(*bases)}
        if is_dataclass(kind):
            found |= {field.name for field in fields(kind) if field.init}
    return tuple(sorted(found - {"__dict__", "__weakref__"}))


def _set_in(code: CodeType) -> Iterable[str]:
    """Yield the names of attributes that code sets."""
    steps = zip(code.co_code[::2], code.co_code[1::2], strict=True)
    return (code.co_names[name] for step, name in steps if step == opmap["STORE_ATTR"])


def _put_fields(thing: Any, found: tuple[dict[str, Any], list[str]]) -> None:
    changed, gone = found
    for name, value in changed.items():
        object.__setattr__(thing, name, value)
    for name in gone:
        object.__delattr__(thing, name)


def _of_partial(thing: partial[Any]) -> Inner:
    return enumerate((thing.func, *thing.args, *thing.keywords.values()))


def _of_function(thing: FunctionType) -> Inner:
    return enumerate((*(thing.__closure__ or ()), *(thing.__defaults__ or ())))


def _items(thing: Mapping[object, Any]) -> Inner:
    return thing.items()


def _through(name: str) -> Callable[[Any], Inner]:
    return lambda thing: ((name, getattr(thing, name)),)


KINDS = (
    PartKind("program", (type, ModuleType, compiled, Struct, "CPUDispatcher")),
    PartKind(
        "config",
        (
            *(LevelContext, Layout, MailboxSpec, TaskSpec, Keeping, BaseModel, Enum, PurePath),
            *(range, np.dtype, np.ufunc, "MjModel"),
        ),
    ),
    # Of one process alone, or of the whole rack.
    PartKind(
        "process",
        (Segment, FaultEntry, RequestEntry, Semaphore, ByteLock, Keeper, mmap, CArray, "PyCapsule"),
    ),
    # What it holds is made again when it is asked for.
    PartKind("cache", (_lru_cache_wrapper,)),
    PartKind("tuple", (tuple,), enumerate),
    PartKind("mapping", (MappingProxyType,), _items),
    PartKind("function", (FunctionType,), _of_function),
    PartKind("method", (MethodType, MethodWrapperType, BuiltinFunctionType), _through("__self__")),
    PartKind("partial", (partial,), _of_partial),
    PartKind("view", (memoryview,), _through("obj")),
    PartKind("record", (np.void,), _through("base")),
    PartKind("array", (np.ndarray,), _through("base"), _elements, _put_array),
    PartKind("bytes", (bytearray,), nothing, bytes, _put_bytes),
    PartKind("list", (list, deque), enumerate, list, _put_list),
    PartKind("dict", (dict,), _items, lambda thing: [*thing, *thing.values()], _put_dict),
    PartKind("set", (set,), nothing, list, _put_set),
    PartKind(
        "cell", (CellType,), _through("cell_contents"), lambda t: [t.cell_contents], _put_cell
    ),
    PartKind("simulation", ("MjData",), nothing, _data, _put_data),
)
_FOUND: dict[type, PartKind] = {}


def part_kind(kind: type) -> PartKind:
    """Return the kind of a type. Raises `CheckpointError` for one that is not known: nobody can
    tell what of it changes."""
    if kind not in _FOUND:
        known = (found for found in KINDS if _is_one_of(kind, found.types))
        _FOUND[kind] = next(known, None) or _object(kind)
    return _FOUND[kind]


def _is_one_of(kind: type, types: tuple[type | str, ...]) -> bool:
    return kind.__name__ in types or issubclass(
        kind, tuple(each for each in types if isinstance(each, type))
    )


def _frozen(thing: Any) -> Inner:
    return ((field.name, getattr(thing, field.name)) for field in fields(thing))


def _object(kind: type) -> PartKind:
    """Return the kind of a class in Python: its attributes may change, but for those of a frozen
    dataclass, and those that its objects find again."""
    if is_dataclass(kind) and kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        return PartKind("frozen dataclass", (kind,), _frozen)
    if not (kind.__dictoffset__ or any("__slots__" in vars(base) for base in kind.__mro__)):
        raise CheckpointError(f"a {kind.__module__}.{kind.__qualname__} has no checkpoint")
    attributes = partial(_fields, _names(kind), getattr(kind, FOUND_AGAIN, ()))
    return PartKind(
        "object",
        (kind,),
        lambda thing: attributes(thing).named.items(),
        attributes,
        _put_fields,
        _has_same_fields,
    )


def changes(now: Any, before: Any) -> Any:
    """Return what has changed in contents, None if nothing has.

    Of an object that is the attributes with another value, and the names of those that are gone; of
    an array the elements, after their places; otherwise all.
    """
    match now:
        case ObjectState(now):
            changed = {
                name: v for name, v in now.items() if before.named.get(name, _ABSENT) is not v
            }
            gone = [name for name in before.named if name not in now]
            return (changed, gone) if changed or gone else None
        case Elements(raw, size):
            if raw == before.raw:
                return None
            # One array may hold both parameters and state.
            elements = np.frombuffer(raw, f"V{size}")
            differs = elements != np.frombuffer(before.raw, elements.dtype)
            places = np.flatnonzero(differs).astype(np.int32)
            return places.tobytes(), elements[places].tobytes()
        case list():
            same = len(now) == len(before) and all(map(is_, now, before))
            return None if same else now
        case _:
            return None if now == before else now
