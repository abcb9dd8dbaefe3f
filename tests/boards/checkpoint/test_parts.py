"""Parts are put back in place; a checkpoint makes no objects but those it needs."""

from __future__ import annotations

import ctypes
import gc
import os
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.boards import checkpoint
from rack.boards.checkpoint.kinds import KINDS
from rack.boards.checkpoint.parts import Parts
from rack.boards.errors import CheckpointError


class Whole:
    """Something built twice alike."""

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain
        self.list = [1.5, 2.5]
        self.other = self.list
        self.array = np.arange(4.0)
        self.view = self.array[2:]
        self.ports = Ports(one=1)
        self.table = self.ports.__dict__
        self.gone: int | None = 1


def test_contents_are_put_back_in_place_and_stay_shared() -> None:
    one = Whole()
    parts = Parts(one, "one")
    one.list[0] = 3.5
    one.view[:] = 7.0
    one.table["two"] = one.list
    del one.gone
    other = Whole()
    array, found = other.array, other.list
    again = Parts(other, "other")
    assert again.shape == parts.shape
    again.load(parts.save(), ())
    assert other.list is other.other is other.ports.two is found
    assert found == [3.5, 2.5]
    assert other.array is array
    assert array.tolist() == [0.0, 1.0, 7.0, 7.0]
    assert not hasattr(other, "gone")


def test_what_nothing_has_changed_stays_as_the_constructor_made_it() -> None:
    one = Whole()
    parts = Parts(one, "one")
    one.list.append(9.5)
    other = Whole(gain=4.0)
    Parts(other, "other").load(parts.save(), ())
    assert (other.gain, other.list) == (4.0, [1.5, 2.5, 9.5])


class Slotted:
    """Attributes in slots, and others."""

    __slots__ = ("__dict__", "kept", "unset")

    def __init__(self) -> None:
        self.kept = 1


def test_attributes_are_found_wherever_they_are_set() -> None:
    one, other = Whole(), Whole()
    for each in (one, other):
        each.slotted = Slotted()  # type: ignore[attr-defined]
    parts, again = Parts(one, "one"), Parts(other, "other")
    one.slotted.kept = 2  # type: ignore[attr-defined]
    one.slotted.unset = 3  # type: ignore[attr-defined]
    one.slotted.foreign = 4  # type: ignore[attr-defined]
    one.new = 5  # type: ignore[attr-defined]
    again.load(parts.save(), ())
    found = other.slotted  # type: ignore[attr-defined]
    assert (found.kept, found.unset, found.foreign, other.new) == (2, 3, 4, 5)  # type: ignore[attr-defined]


def test_a_look_at_parts_makes_no_dictionary_of_the_attributes_of_an_object() -> None:
    one = Whole()
    parts = Parts(one, "one")
    one.gain = 2.5
    parts.save()
    # It would refer to the dictionary alone.
    assert any(found is one.list for found in gc.get_referents(one))


def test_another_shape_is_another_class_attribute_or_size() -> None:
    named, larger, longer = Whole(), Whole(), Whole()
    named.more = 1  # type: ignore[attr-defined]
    larger.array = np.zeros(5)
    longer.list.append(0.5)
    assert len({Parts(one, "one").shape for one in (Whole(), named, larger, Ports(one=1))}) == 4
    assert Parts(longer, "one").shape == Parts(Whole(), "one").shape


def test_a_view_of_foreign_memory_cannot_be_kept() -> None:
    one = Whole()
    parts = Parts(one, "one")
    one.gone = np.frombuffer((ctypes.c_double * 2)())  # type: ignore[assignment]
    with pytest.raises(CheckpointError, match=r"^one: a view of the memory of a c_double_Array_2$"):
        parts.save()


class _Calls:
    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._called = function, arguments

    def __reduce__(self) -> Any:
        return self._called


@pytest.mark.parametrize(
    "called",
    [
        _Calls(os.system, "true"),
        _Calls(eval, "1"),
        _Calls(getattr, _Calls(np.dtype, "f8"), "__class__"),
        _Calls(getattr, [], "append"),
        _Calls(np.load, "file"),
    ],
    ids=lambda called: str(called._called[0].__name__),
)
def test_a_checkpoint_calls_nothing_but_what_it_needs(called: _Calls) -> None:
    one = Whole()
    with pytest.raises(CheckpointError):
        Parts(one, "one").load(pickle.dumps({0: called}), ())


def test_the_page_says_what_of_each_kind_is_kept() -> None:
    page = Path(checkpoint.__file__).parents[1].joinpath("README.md").read_text()
    rows = re.findall(r"^  \| ([a-z, ]+) \| .*\|$", page, re.MULTILINE)
    named = [name for row in rows[1:] for name in row.split(", ")]
    assert named == [*(kind.name for kind in KINDS), "frozen dataclass", "object"]
