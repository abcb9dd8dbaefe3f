"""A rack of the project in one process, straight from its config."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rack.backplane.message import Message, State
from rack.boards.config import RackConfig, load
from rack.levels.level import Executor, Planner
from rack.levels.references import find_class
from rack.levels.tables import MotionConfig, RobotConfig, SceneConfig
from tests.levels.arms import config as arm_config
from tests.levels.lockstep import BoardSpec, Lockstep


class WholeRack(Lockstep):
    """All boards of config `name`, perhaps with another arm and cell, or other actions."""

    def __init__(
        self,
        name: str = "nasrem",
        arm: str | tuple[RobotConfig, SceneConfig] | None = None,
        actions: Sequence[Mapping[str, Any]] | None = None,
        motion: Sequence[MotionConfig] = (),
        params: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        config = load(name)
        found = arm_config(arm) if isinstance(arm, str) else arm
        robot, scene = found or (config.robot, config.scene)
        assert robot is not None
        task = config.task if actions is None else {"action": list(actions)}
        boards = [board(config, name, (params or {}).get(name, {})) for name in config.board]
        cell = scene.model_copy(update={"motion": tuple(motion)})
        super().__init__(boards, robot, cell, task, config.seed, clock_ns=config.clock_ns)

    @property
    def task(self) -> Message:
        return self.read("task.status")

    @property
    def move(self) -> Message:
        return self.read("elemental_move.status")

    @property
    def primitive(self) -> Message:
        return self.read("primitive.status")

    def run_to_end(self, most_s: float) -> Message:
        """Run until the task is done or has failed, at most `most_s`, s; return its status."""
        self.run(most_s, lambda rack: rack.read("task.status").state in (State.DONE, State.ERROR))
        return self.task


def board(config: RackConfig, name: str, params: Mapping[str, Any]) -> BoardSpec:
    """Return what a test's rack needs of a board's config."""
    table = config.board[name]
    return BoardSpec(
        name=name,
        every=config.find_period(name),
        executor=find_class(table.executor, Executor),
        planner=find_class(table.planner, Planner) if table.planner is not None else None,
        within_cycles=table.within_cycles,
        above="".join(table.above),
        below="".join(table.below),
        params={**table.params, **params},
    )
