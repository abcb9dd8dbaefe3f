"""A rack of empty boards that pass a message along, distributed over all cores.

The first board sends a message in every cycle, and each other one passes it on.
"""

from __future__ import annotations

import os
from typing import Any, NamedTuple

from rack.backplane.layout import Wake
from rack.boards.config.schema import CLOCK_SLOT, Mode
from rack.boards.config.toml import to_toml
from rack.tools.lab.benches import relay

# SCHED_FIFO priorities, as in the bundled configs.
CLOCK_PRIORITY = 90
BOARD_PRIORITY = 80


class Chain(NamedTuple):
    """A rack whose boards pass on a message from one to the next, with one cycle per tick.

    The clock runs on the first core. The boards are distributed over the cores, starting with the
    last core.

    Attributes:
        boards: Number of boards.
        rate_hz: Rate of the clock, Hz.
        mode: Clock mode.
        wake: How tasks wait for their cycles.
    """

    boards: int
    rate_hz: int
    mode: Mode = "realtime"
    wake: Wake = "signal"

    @property
    def names(self) -> list[str]:
        """Names of the boards, in the order in which they pass the message."""
        return [f"board{number}" for number in range(1, self.boards + 1)]

    def format_config(self) -> str:
        """Format the config of the rack as TOML."""
        cores = sorted(os.sched_getaffinity(0))
        boards: dict[str, Any] = {}
        for number, name in enumerate(self.names):
            boards[name] = {
                "slot": CLOCK_SLOT + 1 + number,
                "core": cores[-1 - number % len(cores)],
                "every": 1,
                "priority": BOARD_PRIORITY,
                "executor": f"{relay.__name__}:{'Relay' if number else 'FirstBoard'}",
            }
            if number:
                boards[name]["reads"] = {"message": f"board{number}.status"}
        clock = {"period_ms": 1e3 / self.rate_hz, "mode": self.mode, "wake": self.wake}
        return to_toml(
            {
                "name": f"bench-{os.getpid()}",
                "clock": clock | {"core": cores[0], "priority": CLOCK_PRIORITY},
                "board": boards,
            }
        )
