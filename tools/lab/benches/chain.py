"""A rack of empty boards, on all cores in turn: the first sends a message in every cycle, each
other passes it on."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rack.backplane.layout import Wake
from rack.boards.config.schema import CLOCK_SLOT, LAST_SLOT, Mode
from rack.boards.config.toml import to_toml
from rack.tools.lab.benches import relay

LONGEST = LAST_SLOT - CLOCK_SLOT
"""Boards that a crate takes."""
CLOCK_PRIORITY = 90
PRIORITY = 80
"""SCHED_FIFO priorities, as in the bundled configs."""
LEVELS = "relay_levels"
"""Module of the levels in another checkout."""


class Chain(NamedTuple):
    """`boards` boards at the clock's `rate_hz`; the first is on the last core, the clock on the
    first."""

    boards: int
    rate_hz: int
    mode: Mode = "realtime"
    wake: Wake = "signal"

    @property
    def names(self) -> list[str]:
        """The boards, in the order of the message."""
        return [f"board{number}" for number in range(1, self.boards + 1)]

    def text(self, module: str = relay.__name__, path: Sequence[Path] = ()) -> str:
        """Return the rack's config; its levels are in `module`, which is imported from `path`."""
        cores = sorted(os.sched_getaffinity(0))
        clock = {"period_ms": 1e3 / self.rate_hz, "mode": self.mode, "wake": self.wake}
        return to_toml(
            {
                "name": f"bench-{os.getpid()}",
                "python_path": [str(folder) for folder in path],
                "clock": clock | {"core": cores[0], "priority": CLOCK_PRIORITY},
                "board": dict(self._boards(module, cores)),
            }
        )

    def write(self, folder: Path) -> Path:
        """Write the config, and its levels for any checkout, into a folder; return its path."""
        (folder / f"{LEVELS}.py").write_text(Path(relay.__file__).read_text())
        path = folder / f"chain{self.boards}.toml"
        path.write_text(self.text(LEVELS, [folder]))
        return path

    def _boards(self, module: str, cores: Sequence[int]) -> Iterator[tuple[str, dict[str, Any]]]:
        before = None
        for number, name in enumerate(self.names):
            slot = CLOCK_SLOT + 1 + number
            core = cores[-1 - number % len(cores)]
            board: dict[str, Any] = {"slot": slot, "core": core, "every": 1, "priority": PRIORITY}
            if before is None:
                yield name, board | {"executor": f"{module}:Sender"}
            else:
                yield (
                    name,
                    board
                    | {"executor": f"{module}:Relay", "reads": {"message": f"{before}.status"}},
                )
            before = name
