"""Configs: found, merged, validated, and wired into the layout of a rack."""

from rack.boards.config.context import context
from rack.boards.config.cores import shared_out
from rack.boards.config.files import CONFIGS, FAULTS, names
from rack.boards.config.loading import load, loads
from rack.boards.config.ports import TaskPorts, task_ports
from rack.boards.config.schema import CLOCK_SLOT, BoardConfig, ClockConfig, RackConfig
from rack.boards.config.timing import budgets, rack_timing
from rack.boards.config.wiring import wire

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
    "rack_timing",
    "shared_out",
    "task_ports",
    "wire",
]
