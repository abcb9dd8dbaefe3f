"""Racks that tests run to their end, with faults in their config."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.events import Outcome
from rack.boards.faults.config import FaultConfig
from tests.processes import BOUND_S


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


def stop(rack: Rack) -> Outcome:
    """Stop a rack of which a test has seen enough."""
    why = "the test has seen enough"
    rack.stop(why)
    outcome = end_of(rack)
    assert why in [event.text for event in rack.events if event.kind == "stop"]
    return outcome
