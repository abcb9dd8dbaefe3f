"""A rack, partitioned otherwise: every planner coupled the same way, everything on so many cores."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from rack.boards.config import RackConfig, loads
from rack.boards.config.schema import LAST_SLOT, BoardConfig, Coupling
from rack.tools.console.answer import Failure


@dataclass(frozen=True)
class Partition:
    """How levels are laid on processors. `cores` is how many there are; a board keeps its core, counted round."""

    coupling: Coupling
    cores: int

    @property
    def name(self) -> str:
        """The partition in words."""
        return f"{self.coupling}, {self.cores} core{'s' if self.cores > 1 else ''}"

    def of(self, config: RackConfig) -> RackConfig:
        """Return the rack in this partition, in real time. Raises `ConfigError` where the rack does not permit it.

        A loose planner gets a board of its own on the core next to its executor's: with one core, on the same.
        """
        free = iter(_free_slots(config))
        boards = {name: self._board(board, free) for name, board in config.board.items()}
        clock = config.clock.model_copy(update={"mode": "realtime", "core": config.clock.core % self.cores})
        changed = config.model_copy(update={"board": boards, "clock": clock})
        # What a copy permits may still be a mistake: the config is read again as a user's own would be.
        return loads(changed.text())

    def _board(self, board: BoardConfig, free: Iterator[int]) -> BoardConfig:
        core = board.core % self.cores
        changes: dict[str, object] = {"core": core, "planner_slot": None, "planner_core": None}
        if board.planner is not None:
            changes["coupling"] = self.coupling
        if board.planner is not None and self.coupling == "loose":
            slot = next(free, None)
            if slot is None:
                raise Failure(f"the crate has no slot left for every planner: slots go up to {LAST_SLOT}")
            changes |= {"planner_slot": slot, "planner_core": (core + 1) % self.cores}
        return board.model_copy(update=changes)


PARTITIONS: tuple[Partition, ...] = tuple(Partition(c, n) for n in (1, 2) for c in ("tight", "loose"))


def _free_slots(config: RackConfig) -> list[int]:
    taken = {board.slot for board in config.board.values()}
    return [slot for slot in range(2, LAST_SLOT + 1) if slot not in taken]
