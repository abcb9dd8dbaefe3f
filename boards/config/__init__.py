"""Configs: found, merged, validated, and wired into the layout of a rack."""

from boards.config.context import context
from boards.config.cores import shared_out
from boards.config.files import CONFIGS, FAULTS, names
from boards.config.loading import load, loads
from boards.config.ports import TaskPorts, task_ports
from boards.config.schema import CLOCK_SLOT, BoardConfig, ClockConfig, RackConfig
from boards.config.timing import budgets, timed_tasks
from boards.config.wiring import wire

__all__ = [
    "CLOCK_SLOT",
    "CONFIGS",
    "FAULTS",
    "BoardConfig",
    "ClockConfig",
    "RackConfig",
    "TaskPorts",
    "budgets",
    "context",
    "load",
    "loads",
    "names",
    "shared_out",
    "task_ports",
    "timed_tasks",
    "wire",
]
