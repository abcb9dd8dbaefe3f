"""Racks that tests run to their end, with faults in their config."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.events import Outcome
from rack.boards.faults.config import FaultConfig
from tests.processes import BOUND_S

END_TICKS = 40
"""Ticks of a run after what it was waited for."""


def faulty(config: RackConfig, *faults: Mapping[str, Any]) -> RackConfig:
    """Return the config with these faults."""
    return config.model_copy(update={"fault": tuple(FaultConfig(**fault) for fault in faults)})


def kill(board: str, tick: int) -> dict[str, Any]:
    """Return the fault that kills a board at a tick."""
    return {"kind": "kill", "board": board, "tick": tick}


def end_of(rack: Rack) -> Outcome:
    """Watch a rack to its end."""
    deadline = time.monotonic() + BOUND_S
    while rack.watch(0.1):
        assert time.monotonic() < deadline
    assert rack.outcome is not None
    return rack.outcome


def digest_of(config: RackConfig, seconds: float | None) -> str:
    """Run a rack and return its digest."""
    with Rack(config) as rack:
        return rack.run(seconds).digest


def watch_until(rack: Rack, condition: Callable[[], object]) -> None:
    """Watch a running rack until a condition holds, however long the machine takes for it."""
    deadline = time.monotonic() + BOUND_S
    while not condition():
        assert rack.watch(0.01), "the run has ended"
        assert time.monotonic() < deadline


def run_until(rack: Rack, condition: Callable[[], object]) -> Outcome:
    """Watch a running rack until a condition holds; then let its time be over soon."""
    watch_until(rack, condition)
    rack.segment.words[System.STOP_TICK] = rack.segment.words[System.TICK] + END_TICKS
    return end_of(rack)


def stop(rack: Rack) -> Outcome:
    """Stop a rack of which a test has seen enough."""
    why = "the test has seen enough"
    rack.stop(why)
    outcome = end_of(rack)
    assert why in [event.text for event in rack.events if event.kind == "stop"]
    return outcome
