"""A change of one board, as a line for people and as settings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rack.boards.config.layout import obtained_core
from rack.boards.config.timing import tick_ns
from rack.tools.timing.prediction import predict
from rack.tools.timing.trial import Trial

TRIED = (
    "priority",
    "planner_priority",
    "within_cycles",
    "coupling",
    "planner_slot",
    "planner_core",
    "core",
    "every",
    "rate_hz",
)
"""Keys of a board's table that changes are made of."""


@dataclass(frozen=True)
class Change:
    """What a board gets other settings for: the rack `before` and `after` it."""

    board: str
    before: Trial
    after: Trial

    @property
    def settings(self) -> dict[str, Any]:
        """The keys of the board's table that change, with their new values; None: the key goes."""
        old, new = (trial.config.board[self.board] for trial in (self.before, self.after))
        return {key: getattr(new, key) for key in TRIED if getattr(old, key) != getattr(new, key)}

    @property
    def cost(self) -> tuple[bool, float, int, int]:
        """What it costs, to be compared: a core that this machine lacks, then slower or older, then boards, then keys.

        A longer cycle makes a level slower and its plans older: both factors count.
        """
        cores = set(self.after.cores.values()) - set(self.before.cores.values())
        lacking = any(obtained_core(core) != core for core in cores)
        old, new = self.before.level(self.board), self.after.level(self.board)
        factor = new.cycle_ns / old.cycle_ns
        if old.slice_ns is not None and new.slice_ns is not None:
            factor *= max(new.slice_ns / old.slice_ns, 1.0)
        return lacking, factor, 2 * len(cores) + ("planner_slot" in self.settings), len(self.settings)

    @property
    def text(self) -> str:
        """The change in one line, with its numbers."""
        return f"board '{self.board}': {', '.join(self._parts())}"

    def document(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {"board": self.board, "text": self.text, "settings": self.settings, "protocols": self._protocols()}

    def _parts(self) -> Iterator[str]:
        old, new = (trial.config.board[self.board] for trial in (self.before, self.after))
        changed = self.settings
        for key in ("priority", "planner_priority"):
            if key in changed:
                yield f"{key} {getattr(old, key)} -> {changed[key]}"
        if "coupling" in changed:
            yield f"coupling {new.coupling}, planner_slot {new.planner_slot}"
        if "planner_core" in changed and new.planner_core is not None:
            was = "" if old.planner_core is None else f"{old.planner_core} -> "
            yield f"planner_core {was}{new.planner_core} ({self._company(new.planner_core)})"
        if "core" in changed:
            yield f"core {old.core} -> {new.core} ({self._company(new.core)})"
        yield from (f"{mailbox} by {protocol}" for mailbox, protocol in self._protocols().items())
        if "every" in changed or "within_cycles" in changed:
            yield from self._cycles()
        if changed.get("coupling") == "loose" and not self.after.level(self.board).exchange_ns:
            yield "reading the plan over the bus not counted: budget.exchange_ms is 0"

    def _cycles(self) -> Iterator[str]:
        old, new = self.before.level(self.board), self.after.level(self.board)
        if new.cycle_ns != old.cycle_ns:
            clock_ns = tick_ns(self.after.config)
            every = f"every {old.cycle_ns // clock_ns} -> {new.cycle_ns // clock_ns}"
            yield f"{every} (cycle {old.cycle_ns * 1e-6:g} -> {new.cycle_ns * 1e-6:g} ms{self._response()})"
        if new.slice_ns is not None:
            age = f"a plan every {new.slice_ns * 1e-6:g} ms"
            same = new.within_cycles == old.within_cycles
            yield age if same else f"within_cycles {old.within_cycles} -> {new.within_cycles} ({age})"

    def _response(self) -> str:
        """Return what the change does to the system's response time."""
        old, new = (predict(trial.config, trial.layout).command_ms for trial in (self.before, self.after))
        return f"; R_s {old:g} -> {new:g} ms" if new != old else ""

    def _company(self, core: int) -> str:
        """Return who else is on that core, and whether this machine has it."""
        own = (self.board, f"{self.board}.planner")
        others = [name for name, place in self.after.cores.items() if place == core and name not in own]
        company, obtained = f"beside {', '.join(others)}" if others else "a core of its own", obtained_core(core)
        return company if obtained == core else f"{company}; this machine has no core {core} and gives core {obtained}"

    def _protocols(self) -> dict[str, str]:
        old, new = (trial.config.protocol.mailbox for trial in (self.before, self.after))
        return {mailbox: protocol for mailbox, protocol in new.items() if old.get(mailbox) != protocol}
