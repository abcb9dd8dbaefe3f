"""Cores: what the config asks for and what the machine has."""

from __future__ import annotations

import os

from rack.boards.config.schema import RackConfig


def obtained_core(core: int) -> int:
    """Return the core that a task asking for `core` gets; cores the machine lacks are shared out in turn."""
    available = sorted(os.sched_getaffinity(0))
    return core if core in available else available[core % len(available)]


def shared_out(config: RackConfig) -> list[str]:
    """Return one line for every core that is asked for and not there, for the launch to print."""
    wanted: dict[int, list[str]] = {config.clock.core: ["clock"]}
    for name, board in config.board.items():
        wanted.setdefault(board.core, []).append(name)
        if board.planner_core is not None:
            wanted.setdefault(board.planner_core, []).append(f"{name}.planner")
    available = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
    return [
        f"core {core} is not available (available: {available}): {', '.join(tasks)} on core {obtained_core(core)}"
        for core, tasks in sorted(wanted.items())
        if obtained_core(core) != core
    ]
