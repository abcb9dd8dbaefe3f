"""What one task needs to run: its class and the mailboxes behind its ports. Plain data, sent to the crate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rack.boards.transfer import Transfer
from rack.levels.level import LevelContext


@dataclass(frozen=True)
class TaskWiring:
    """One task: `target` is "package.module:Class"; `inputs` and `outputs` map ports to mailboxes.

    `critical_priority` is the SCHED_FIFO priority that a tight planner takes for its plan update. `guards_clock`: the
    task, one of the fastest, looks after the clock. `fails_self_test` is a fault of the config.
    """

    task: str
    target: str
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    context: LevelContext
    poll: bool = False
    critical_priority: int = 0
    guards_clock: bool = False
    fails_self_test: bool = False
    transfer: Transfer = field(default_factory=Transfer)
