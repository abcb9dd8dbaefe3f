"""The `[[fault]]` tables of a config: a fault as it is asked for, before the rack that it is for is looked at."""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, Field

from rack.levels.tables import LAST_TICK, Finite, Table

DURATION = re.compile(r"\s*([0-9.]+(?:e-?[0-9]+)?)\s*(ms|s)\s*")


def _seconds(value: Any) -> Any:
    """Return a duration in s. Raises `ValueError`."""
    if not isinstance(value, str):
        return value
    found = DURATION.fullmatch(value)
    if found is None:
        raise ValueError('should be a time, as in "0.5s", "20ms" or 0.5')
    return float(found[1]) * (1e-3 if found[2] == "ms" else 1.0)


def _number(value: Any) -> Any:
    """Return a switch as 0 or 1: parameters are numbers, `random = true` is one."""
    return float(value) if isinstance(value, bool) else value


Parameter = Annotated[Finite, BeforeValidator(_number)]
Seconds = Annotated[float, BeforeValidator(_seconds), Field(gt=0, le=1e6, allow_inf_nan=False)]


class FaultConfig(Table):
    """`[[fault]]`: one fault. Keys that are not named here are parameters of its kind, numbers."""

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, Parameter]

    kind: str = Field(description="what goes wrong; 'rack inject --help' lists the kinds")
    board: str = Field(description="task concerned: a board, as in servo, its planner, as in servo.planner, or clock")
    tick: int | None = Field(
        None, ge=0, le=LAST_TICK, description="first tick; at most one of tick, at and when; none: at the start"
    )
    at: float | None = Field(None, ge=0, le=1e9, allow_inf_nan=False, description="instead of tick: simulated time, s")
    when: str | None = Field(
        None, description='instead of tick: once a field has a value, as in "elemental_move.status.verb == grasp"'
    )
    lasts: Seconds | None = Field(
        None, alias="for", description='simulated time that it lasts, as in "0.5s", "20ms" or 0.5; or give cycles'
    )
    cycles: int | None = Field(None, ge=1, le=10**6, description="instead of for: cycles of the task that it lasts")
    phase: float = Field(
        0.0, ge=0, lt=1, description="when in its first tick it strikes, in ticks of real time; not in lockstep"
    )
    mailbox: str | None = Field(
        None, description="mailbox concerned; default: all that the task writes, for masquerade the first"
    )
    seed: int | None = Field(None, ge=0, le=2**31 - 1, description="seed; default: from the rack's and the place")

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters given, by name; whether the kind takes them is not known here."""
        return dict(self.__pydantic_extra__ or {})
