"""The rack for tests of faults: a wave with its planner, a watch on it, and a driven board."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rack.boards.config.schema import RackConfig
from tests.boards.conftest import PLANNED, MakeConfig, format_board

DRIVEN = PLANNED + format_board("driven", 4, "fault_levels:Driven", rate_hz=200)
PATIENCE_TICKS = 300
"""Longer than a restart in lockstep, shorter than the longest faults of a test."""
FOLLOWED = PLANNED.replace(
    'executor = "wave_levels:Watch"',
    f'executor = "fault_levels:Follower"\nparams = {{ patience = {PATIENCE_TICKS} }}',
)
LOCKED = "protocol.default=lock"
COMPARED = ("board.wave.standby={slot=9,core=0}", "board.wave.compare=true")
OF_KINDS = {"lock": (LOCKED,), "copy": COMPARED}
"""Settings of the rack by the kind's `where`."""
TARGETS = {"overrun": "wave", "planner-slow": "wave.planner", "clock": "clock", "arm": "driven"}
"""A task to strike, by kind or by the kind's `where`; for all others it is the wave."""


def rack(
    config: MakeConfig, *faults: Mapping[str, Any], settings: tuple[str, ...] = ()
) -> RackConfig:
    """Return the rack in real time with these faults in its config."""
    tables = ", ".join(inline(fault) for fault in faults)
    return config("clock.mode=realtime", f"fault=[{tables}]", *settings, text=DRIVEN)


def inline(fault: Mapping[str, Any]) -> str:
    """Return a fault as an inline table of TOML."""
    return "{" + ", ".join(f"{key} = {_value(value)}" for key, value in fault.items()) + "}"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"'{value}'" if isinstance(value, str) else str(value)
