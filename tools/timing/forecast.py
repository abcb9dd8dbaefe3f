"""All that the timing model says of a rack before it is launched, as plain data and as text."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from rack.boards.config import shared_out
from rack.tools.timing.level_timing import LevelTiming, level_timings, unjudged
from rack.tools.timing.prediction import Prediction, predict
from rack.tools.timing.tables import level_table, ms, response_table, verdict_table
from rack.tools.timing.task_response import TaskResponse, task_responses
from rack.tools.timing.trial import Trial
from rack.tools.timing.verdict import Verdict
from rack.tools.timing.verdicts import LOAD, RESPONSE_TIME, context_switch_ns


@dataclass(frozen=True)
class Forecast:
    """The timing of a rack from its budgets. `loads` are by core; `notes` say what the numbers leave out."""

    system: Prediction
    context_switch_ns: int
    levels: tuple[LevelTiming, ...]
    verdicts: tuple[Verdict, ...]
    responses: tuple[TaskResponse, ...]
    loads: dict[int, float]
    notes: tuple[str, ...]

    @classmethod
    def of(cls, trial: Trial) -> Forecast:
        """Return what the model says of a trial."""
        config, layout, budgets = trial.config, trial.layout, trial.budgets
        switch_ns = context_switch_ns(config)
        return cls(
            system=predict(config, layout),
            context_switch_ns=switch_ns,
            levels=level_timings(config, layout, budgets),
            verdicts=trial.verdicts,
            responses=task_responses(trial.tasks, switch_ns),
            loads=trial.loads,
            notes=tuple(_notes(trial)),
        )

    @property
    def holds(self) -> bool:
        """Whether all that could be judged holds."""
        return all(verdict.holds for verdict in self.verdicts)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data; times whose names end in _ns are of the wall clock."""
        return {
            **asdict(self.system),
            "context_switch_ns": self.context_switch_ns,
            "levels": [level.document() for level in self.levels],
            "verdicts": [verdict.document() for verdict in self.verdicts],
            "responses": [response.document() for response in self.responses],
            "loads": {str(core): load for core, load in self.loads.items()},
            "notes": list(self.notes),
            "holds": self.holds,
        }

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield everything that fits into `width` as text for people."""
        yield from self.system.lines()
        if self.levels:
            yield from ("", f"worst case by the budgets, ms, with t_cs {ms(self.context_switch_ns)} ms:", "")
            yield from level_table(self.levels, width)
        paper = [verdict for verdict in self.verdicts if verdict.equation not in (RESPONSE_TIME, LOAD)]
        if paper:
            yield ""
            yield from verdict_table(paper, width)
        if self.responses:
            yield from ("", "response times of the tasks that share a core, by priority, ms:", "")
            yield from response_table(self.responses, width)
            yield ""
            loads = (f"core {core} {load:.3f}{' FAILS' if load > 1 else ''}" for core, load in self.loads.items())
            yield f"load: {', '.join(loads)}"
        yield from self.notes


def _notes(trial: Trial) -> Iterator[str]:
    config = trial.config
    if trial.budgets and config.clock.mode == "lockstep":
        yield "in lockstep a tick waits for whoever is late: this is the timing of the same rack in real time"
    if trial.budgets and config.clock.speed != 1.0:
        yield f"times are of the wall clock: at speed {config.clock.speed:g} cycles change, budgets do not"
    if trial.budgets and shared_out(config):
        yield "cores are those that the config asks for, not those that this machine gives"
    yield from unjudged(config, trial.budgets)
    sharing = [task for task in trial.tasks if task.cost_ns and not task.priority]
    crowded = [task.name for task in sharing if sum(other.core == task.core for other in sharing) > 1]
    if crowded:
        yield f"ordinary scheduling promises nothing, these are bounds for fair turns: {', '.join(crowded)}"
