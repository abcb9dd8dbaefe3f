"""What a level is told of its rack."""

from __future__ import annotations

from typing import cast

from rack.boards.config.cell import cell_sizes
from rack.boards.config.schema import RackConfig
from rack.boards.errors import ConfigError, Mistake
from rack.levels.level import LevelContext, Pace
from rack.levels.tables import RobotConfig


def context(config: RackConfig, board: str) -> LevelContext:
    """Return the context of a board's level. Raises `ConfigError` when the arm or its cell cannot be built."""
    mistakes: list[Mistake] = []
    sizes = cell_sizes(config, mistakes)
    if mistakes:
        raise ConfigError(mistakes)
    below = config.board[board].below
    return LevelContext(
        board=board,
        every=config.every(board),
        within_cycles=config.board[board].within_cycles,
        clock_ns=config.clock_ns,
        seed=config.seed,
        # A rack without an arm has levels that do not ask for one.
        robot=cast(RobotConfig, config.robot),
        scene=config.scene,
        task=config.task,
        sizes=sizes,
        below=Pace(config.every(below), config.board[below].within_cycles) if below is not None else None,
        params=config.board[board].params,
    )
