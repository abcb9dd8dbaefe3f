"""A config put to the timing model: what fails, and what fails when something in it is changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout, Protocol
from rack.boards.config import RackConfig, loads, wire
from rack.boards.config.timing import asked_core, tick_ns, timed_tasks
from rack.boards.errors import ConfigError
from rack.levels.timing.budget import Budget
from rack.levels.timing.response_time import load_of
from rack.levels.timing.tasks import TimedTask
from rack.tools.timing.level_timing import LevelTiming, level_timings
from rack.tools.timing.verdict import Verdict
from rack.tools.timing.verdicts import LOAD, context_switch_ns, level_verdicts, system_verdicts, verdicts

Settings = Mapping[str, Any]
"""Keys of a board's table with their new values; None takes a key out."""


@dataclass(frozen=True)
class Trial:
    """A config that loads, with the verdicts on it."""

    config: RackConfig
    layout: Layout
    budgets: Mapping[str, Budget]
    verdicts: tuple[Verdict, ...]

    @classmethod
    def of(cls, config: RackConfig, budgets: Mapping[str, Budget]) -> Trial:
        """Wire a config and judge it. Raises `ConfigError`."""
        layout = wire(config)
        return cls(config, layout, budgets, tuple(verdicts(config, layout, budgets)))

    def changed(self, board: str, settings: Settings, mailboxes: Mapping[str, Protocol] | None = None) -> Trial | None:
        """Return the trial of the config with other settings of a board, loaded anew; None: such a config is refused.

        `mailboxes` are those that get another protocol.
        """
        config = self.config
        boards = {**config.board, board: config.board[board].model_copy(update=dict(settings))}
        update: dict[str, Any] = {"board": boards}
        if mailboxes:
            protocols = {**config.protocol.mailbox, **mailboxes}
            update["protocol"] = config.protocol.model_copy(update={"mailbox": protocols})
        try:
            # What a copy permits may still be a mistake: the loader alone can tell.
            return Trial.of(loads(config.model_copy(update=update).text()), self.budgets)
        except ConfigError:
            return None

    @property
    def tasks(self) -> tuple[TimedTask, ...]:
        """The tasks that the budgets tell of."""
        return timed_tasks(self.config, self.layout, self.budgets)

    @property
    def loads(self) -> dict[int, float]:
        """The load of every core, 1 at most for one that keeps up."""
        return load_of(self.tasks, context_switch_ns(self.config))

    @property
    def failing(self) -> tuple[Verdict, ...]:
        """The verdicts of what fails."""
        return tuple(verdict for verdict in self.verdicts if not verdict.holds)

    def failing_of(self, board: str) -> set[tuple[str, str, str]]:
        """Return what fails of a board's own tasks; where nothing does, the overload of the cores they are on."""
        names = {board, f"{board}.planner"}
        own = {_key(verdict) for verdict in self.failing if verdict.subject in names}
        cores = {f"core {core}" for core in self.cores_of(board)}
        return own or {_key(v) for v in self.failing if v.equation == LOAD and v.subject in cores}

    def cures(self, board: str, before: Trial) -> bool:
        """Say whether nothing of the board fails that did `before`, nor anything else that did not."""
        failing = {_key(verdict) for verdict in self.failing}
        old = {_key(verdict) for verdict in before.failing}
        return failing < old and not failing & before.failing_of(board)

    def level(self, board: str) -> LevelTiming:
        """Return the timing of a level that has a budget. Raises `KeyError`."""
        return {level.board: level for level in level_timings(self.config, self.layout, self.budgets)}[board]

    def is_sound(self, level: LevelTiming) -> bool:
        """Say whether a level, changed, passes the equations by itself and lets the system respond as before.

        That is quickly told; what it does to others on its core is not.
        """
        config, clock_ns = self.config, tick_ns(self.config)
        cycles = {task.name: task.every for task in self.layout.tasks} | {level.board: level.cycle_ns // clock_ns}
        old = {_key(verdict) for verdict in self.failing}
        own = level_verdicts(level, clock_ns, context_switch_ns(config), config.timing.small_share)
        system = (verdict for verdict in system_verdicts(config, cycles) if _key(verdict) not in old)
        return all(verdict.holds for verdict in chain(own, system))

    @property
    def cores(self) -> dict[str, int]:
        """The cores that the config asks for, by task, the clock's first; whether or not the machine has them."""
        asked = {task.name: asked_core(self.config.board[task.board], task.role) for task in self.layout.tasks}
        return {CLOCK: self.config.clock.core, **asked}

    def cores_of(self, board: str) -> set[int]:
        """Return the cores that a board's tasks are on."""
        return {core for name, core in self.cores.items() if name.partition(".")[0] == board}


def _key(verdict: Verdict) -> tuple[str, str, str]:
    return verdict.equation, verdict.subject, verdict.meaning
