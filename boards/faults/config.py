"""`[[fault]]` tables: faults as users write them, and the conditions that start them."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field

from rack.backplane.checked import select_item
from rack.backplane.layout import Layout
from rack.levels.tables import Finite, Moment, Table, Tick

CONDITION = re.compile(r"\s*([a-z]\w*\.[a-z]\w*)\.([a-z]\w*)\s*==\s*([+-]?\w+)\s*")
_DURATION = re.compile(r"\s*([0-9.]+(?:e-?[0-9]+)?)\s*(ms|s|min)\s*")
_UNIT_S = {"ms": 1e-3, "s": 1.0, "min": 60.0}


def parse_seconds(value: Any) -> Any:
    """Convert a duration such as "20ms" to seconds. Values other than text are returned unchanged.

    Raises:
        ValueError: The text is not a duration.
    """
    if not isinstance(value, str):
        return value
    match = _DURATION.fullmatch(value)
    if match is None:
        raise ValueError('should be a time, as in "0.5s", "20ms" or 0.5')
    return float(match[1]) * _UNIT_S[match[2]]


# All parameters are numbers: `random = true` means 1.
Parameter = Annotated[
    Finite, BeforeValidator(lambda value: float(value) if isinstance(value, bool) else value)
]
Seconds = Annotated[float, BeforeValidator(parse_seconds), Field(gt=0, le=1e6, allow_inf_nan=False)]


class FaultConfig(Table):
    """`[[fault]]`: one fault. Keys that are not listed here are numeric parameters of its kind."""

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, Parameter]

    kind: str
    """kind of fault; 'rack inject --list' lists the kinds"""
    board: str
    """affected task: a board (servo), its planner (servo.planner), or clock"""
    tick: Tick | None = None
    """first tick; give at most one of tick, at, when; default: the first of the run"""
    at: Moment | None = None
    """instead of tick: start in simulated time [s]"""
    when: str | None = None
    """instead of tick: start once this holds, as in "elemental_move.status.verb == grasp" """
    lasts: Seconds | None = Field(None, alias="for")
    """duration in simulated time, as in "0.5s", "20ms" or 0.5 (s); or give cycles"""
    cycles: int | None = Field(None, ge=1, le=10**6)
    """instead of for: duration in cycles of the task"""
    phase: float = Field(0.0, ge=0, lt=1)
    """fraction of the first tick that passes before it acts; real time only"""
    mailbox: str | None = None
    """mailbox to affect; default: all that the task writes; for masquerade, the first"""
    seed: int | None = Field(None, ge=0, le=2**31 - 1)
    """seed of its random choices; default: derived from the rack's seed and the fault's place"""

    @property
    def parameters(self) -> dict[str, float]:
        """Dictionary from parameter names to values, not yet checked against the kind."""
        return dict(self.__pydantic_extra__ or {})


def parse_condition(text: str, layout: Layout) -> tuple[int, int, int]:
    """Parse a condition such as "elemental_move.status.verb == grasp".

    Returns:
        Index of the mailbox, index of the field in it, and the number to compare with.

    Raises:
        LookupError: The condition is malformed, or names a mailbox, field or value that does not
            exist.
    """
    match = CONDITION.fullmatch(text)
    if match is None:
        raise LookupError(
            'must be mailbox.field == value, as in "elemental_move.status.verb == grasp"'
        )
    mailboxes = [mailbox.name for mailbox in layout.mailboxes]
    if match[1] not in mailboxes:
        raise LookupError(f"no mailbox '{match[1]}'; mailboxes: {', '.join(mailboxes)}")
    index = mailboxes.index(match[1])
    mailbox = layout.mailboxes[index]
    fields = {
        f.name: f
        for f in mailbox.fields
        if not f.fields and not f.shape and np.dtype(f.kind).kind in "iu"
    }
    if match[2] not in fields:
        raise LookupError(
            f"'{mailbox.name}' has no integer field '{match[2]}'; integer fields:"
            f" {', '.join(fields) or 'none'}"
        )
    field = fields[match[2]]
    value = dict(field.values).get(match[3].lower())
    if value is None:
        limits = np.iinfo(field.kind)
        with suppress(ValueError):
            value = int(match[3])
        if value is None or not limits.min <= value <= limits.max:
            names = ", ".join(dict(field.values))
            valid = names or f"a number from {limits.min} to {limits.max}"
            raise LookupError(f"'{match[3]}' is not a value of '{field.name}'; valid: {valid}")
    return index, mailbox.fields.index(field), value


def format_condition(when: tuple[int, int, int], layout: Layout) -> str:
    """Return a condition as a user writes it. This is the inverse of `parse_condition`."""
    mailbox = select_item(layout.mailboxes, when[0], "mailbox")
    field = select_item(mailbox.fields, when[1], "field")
    names = {number: name for name, number in field.values}
    return f"{mailbox.name}.{field.name} == {names.get(when[2], when[2])}"
