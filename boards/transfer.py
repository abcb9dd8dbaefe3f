"""A slower bus: accesses of one board are made to take processor time, as programmed transfers over VME did."""

from __future__ import annotations

from collections.abc import Callable
from time import process_time_ns
from typing import ParamSpec, TypeVar

from rack.backplane.process import compute_until

_P = ParamSpec("_P")
_R = TypeVar("_R")


def slowed(access: Callable[_P, _R], time_ns: int) -> Callable[_P, _R]:
    """Return `access`, taking at least `time_ns` of processor time; itself where that is 0."""
    if not time_ns:
        return access

    def take(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        end = process_time_ns() + time_ns
        result = access(*args, **kwargs)
        compute_until(end)
        return result

    return take
