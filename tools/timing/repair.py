"""One change after another until a rack fits its cycles, or until nothing helps any more."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rack.tools.timing.change import Change
from rack.tools.timing.changes import LONGEST, changes_for
from rack.tools.timing.trial import Trial
from rack.tools.timing.verdict import Verdict


@dataclass(frozen=True)
class Repair:
    """What makes a rack fit. `steps` have each the changes for a board, cheapest first, which the next one rests on."""

    steps: tuple[tuple[Change, ...], ...]
    end: Trial

    @property
    def left(self) -> tuple[Verdict, ...]:
        """What still fails behind the last step."""
        return self.end.failing

    def lines(self) -> list[str]:
        """Return every step as text, a line a change, and what they leave."""
        found: list[str] = []
        for changes in self.steps:
            start = "with the first of those, then" if found else "what would do"
            found.append(f"{start}{', any one of them, the cheapest first' if len(changes) > 1 else ''}:")
            found += [f"  {change.text}" for change in changes]
        if self.left:
            failing = ", ".join(dict.fromkeys(f"{verdict.equation} of {verdict.subject}" for verdict in self.left))
            tried = f"other priorities and cores, plans and cycles up to {LONGEST} times as long, others' cycles too"
            found.append(f"nothing helps against {failing}; tried: {tried}")
        return found

    def document(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "steps": [[change.document() for change in changes] for changes in self.steps],
            "fits": not self.left,
        }


def repair(trial: Trial) -> Repair:
    """Return the changes that make a rack fit: the cheapest for one board, then with it those for the next one."""
    steps: list[tuple[Change, ...]] = []
    while trial.failing:
        found = next((changes for board in _ailing(trial) if (changes := changes_for(trial, board))), None)
        if found is None:
            break
        steps.append(tuple(found))
        trial = found[0].after
    return Repair(tuple(steps), trial)


def _ailing(trial: Trial) -> list[str]:
    """Return the boards of which something fails, those first that others wait for."""
    boards = trial.config.board
    failing = [name for name in boards if name in trial.budgets and trial.failing_of(name)]
    own = {verdict.subject.partition(".")[0] for verdict in trial.failing}
    # An overloaded core concerns all its boards; who is late on it is asked first.
    return sorted(failing, key=lambda name: (name not in own, -boards[name].priority))
