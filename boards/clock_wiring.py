"""What the clock's board needs to run. Plain data, sent to the crate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rack.backplane.words import Demand


@dataclass(frozen=True)
class ClockWiring:
    """How a run goes in time. `period_ns` is of the wall clock, the speed factor counted in.

    The run ends after `stop_tick` ticks (0: never), or `linger` ticks after the mailbox `ends_run` says
    done or error, or its writer, which is not lost, has said nothing for `silent` ticks. In lockstep a lost board
    rejoins `restart_ticks` after its loss. `on_loss` is what the loss of a task asks of the arm.
    """

    lockstep: bool
    period_ns: int
    stop_tick: int
    ends_run: str | None
    linger: int
    silent: int
    history: int
    core: int
    priority: int
    restart_ticks: int
    on_loss: Mapping[str, Demand]
