"""A config evaluated with the timing model, and changes of one board with their effects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

from rack.backplane.layout import Layout, Protocol
from rack.boards.config import RackConfig, build_rack_timing, load_text, resolve
from rack.boards.config.layout import find_core
from rack.boards.errors import ConfigError
from rack.boards.timing.level import LevelTiming
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.system_response import predict_response
from rack.boards.timing.tasks import Budget
from rack.boards.timing.verdicts import (
    LOAD,
    EquationVerdict,
    evaluate_level,
    evaluate_rack,
    evaluate_response,
)
from rack.tools.console.answer import Document

VerdictKey = tuple[str, str, str]
"""See `EquationVerdict.key`."""
Settings = Mapping[str, Any]
"""Keys of a board's table with their new values. None removes a key."""


@dataclass(frozen=True)
class JudgedConfig:
    """A valid config with its timing model and the verdicts on it."""

    config: RackConfig
    layout: Layout
    timing: RackTiming
    verdicts: tuple[EquationVerdict, ...]

    @classmethod
    def judge(cls, config: RackConfig, budgets: Mapping[str, Budget] | None = None) -> JudgedConfig:
        """Resolve a config and evaluate its timing with `budgets`, or with its own budgets if None.

        Raises:
            ConfigError: If the config is invalid.
        """
        layout = resolve(config).layout
        timing = build_rack_timing(config, layout, budgets)
        return cls(config, layout, timing, tuple(evaluate_rack(timing)))

    @property
    def budgets(self) -> dict[str, Budget]:
        """Dictionary from board names to known budgets."""
        return {
            name: board.budget
            for name, board in self.timing.boards.items()
            if board.budget is not None
        }

    def try_change(self, board: str, settings: Settings) -> Change | None:
        """Change the settings of a board, and load and evaluate the new config.

        Returns:
            The change. None if the new config is invalid.
        """
        config = self.config
        table = config.board[board]
        boards = {**config.board, board: table.model_copy(update=dict(settings))}
        update: dict[str, Any] = {"board": boards}
        protocols: dict[str, Protocol] = {}
        if settings.get("coupling") == "loose" and self.timing.boards[board].is_critical:
            # Between two processors the paper uses time slices or double buffers (section 3.3).
            protocols = {f"{board}.plan": "time-slice"}
            mailboxes = {**config.protocol.mailbox, **protocols}
            update["protocol"] = config.protocol.model_copy(update={"mailbox": mailboxes})
        try:
            # Copying does not validate. Only the loader finds mistakes.
            after = JudgedConfig.judge(
                load_text(config.model_copy(update=update).to_toml_text()), self.budgets
            )
        except ConfigError:
            return None
        changed = {key: value for key, value in settings.items() if value != getattr(table, key)}
        return Change(board, changed, protocols, self, after)

    @property
    def failures(self) -> tuple[EquationVerdict, ...]:
        """Verdicts on equations and bounds that do not hold."""
        return tuple(verdict for verdict in self.verdicts if not verdict.holds)

    @property
    def failing(self) -> set[VerdictKey]:
        """Keys of `failures`."""
        return {verdict.key for verdict in self.failures}

    def find_failures(self, board: str) -> set[VerdictKey]:
        """Return the keys of the failures of a board's tasks.

        If no task fails, return the keys of the overloads of the board's cores.
        """
        names = {board, f"{board}.planner"}
        own = {verdict.key for verdict in self.failures if verdict.subject in names}
        cores = {f"core {core}" for core in self.timing.find_cores(board)}
        return own or {v.key for v in self.failures if v.equation == LOAD and v.subject in cores}

    def is_acceptable_change(self, changed: RackTiming, board: str) -> bool:
        """Return True if a changed board meets its timing equations and the system gets no worse.

        This check is quick and ignores the effect on other tasks of the core.
        """
        response = evaluate_response(changed)
        system = (verdict for verdict in response if verdict.key not in self.failing)
        return all(
            verdict.holds
            for verdict in chain(evaluate_level(changed, changed.levels[board]), system)
        )


@dataclass(frozen=True)
class Change:
    """A change of the settings of one board.

    Attributes:
        board: Name of the board.
        settings: Changed keys of its table with their new values. None removes a key.
        protocols: New protocols of mailboxes.
        before: The rack before the change.
        after: The rack after the change.
    """

    board: str
    settings: Settings
    protocols: Mapping[str, Protocol]
    before: JudgedConfig
    after: JudgedConfig

    @property
    def _level_timings(self) -> tuple[LevelTiming, LevelTiming]:
        """Timing of the board's level before and after the change."""
        return self.before.timing.levels[self.board], self.after.timing.levels[self.board]

    @property
    def cost(self) -> tuple[bool, float, int, int]:
        """Cost for comparison with other changes.

        Its parts are, in order of importance, whether this machine lacks a new core, the slowdown,
        the cost of new cores and slots, and the number of changed keys. A longer cycle makes a
        level slower and its plans older, so the slowdown is the product of both factors.
        """
        cores = {*self.after.timing.cores.values()} - {*self.before.timing.cores.values()}
        is_core_missing = any(find_core(core) != core for core in cores)
        old, new = self._level_timings
        factor = new.cycle_ns / old.cycle_ns
        if old.slice_ns is not None and new.slice_ns is not None:
            factor *= max(new.slice_ns / old.slice_ns, 1.0)
        place_cost = 2 * len(cores) + ("planner_slot" in self.settings)
        return is_core_missing, factor, place_cost, len(self.settings)

    @property
    def text(self) -> str:
        """Description of the change in one line."""
        return f"board '{self.board}': {', '.join(self._list_parts())}"

    def to_document(self) -> Document:
        """Convert the change to plain data."""
        return {
            "board": self.board,
            "text": self.text,
            "settings": self.settings,
            "protocols": self.protocols,
        }

    def _list_parts(self) -> Iterator[str]:
        """Yield a text for each changed setting, and for each effect on the rack."""
        table = self.before.config.board[self.board]
        for key, value in self.settings.items():
            before = getattr(table, key)
            if value is not None:
                yield f"{key} {value}" if before is None else f"{key} {before} -> {value}"
        yield from (f"{mailbox} by {protocol}" for mailbox, protocol in self.protocols.items())
        old, new = self._level_timings
        if new.cycle_ns != old.cycle_ns:
            yield f"cycle {old.cycle_ns * 1e-6:g} -> {new.cycle_ns * 1e-6:g} ms"
        responses = [predict_response(rack.timing).command_ms for rack in (self.before, self.after)]
        if responses[0] != responses[1]:
            yield f"R_s {responses[0]:g} -> {responses[1]:g} ms"
        if new.slice_ns is not None and new.slice_ns != old.slice_ns:
            yield f"a plan every {new.slice_ns * 1e-6:g} ms"
        for key in ("planner_core", "core"):
            core = self.settings.get(key, 0)
            if (obtained := find_core(core)) != core:
                yield f"this machine has no core {core}, uses core {obtained}"
