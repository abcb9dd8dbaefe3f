"""Forecast of the timing of a rack before its launch, from budgets in its config."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any

from rack.backplane.words import Scheduler
from rack.boards.timing.frames import CoreFrames, compute_core_frames
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.system_response import Prediction, predict_response
from rack.boards.timing.verdicts import EquationVerdict, evaluate_rack

NO_BUDGET = "no budget"


@dataclass(frozen=True)
class Forecast:
    """Predicted timing of a rack.

    Attributes:
        rack: Data of the rack.
        system: Predicted system response.
        verdicts: Verdicts of all equations.
        inboxes: Worst-case cost of interrupts for each inbox, as plain data.
        frames: Distinct frames of each core in a static schedule.
        notes: Limits of the prediction, one sentence each.
        uncounted: What the forecast does not include, each with the reason.
    """

    rack: RackTiming
    system: Prediction
    verdicts: tuple[EquationVerdict, ...]
    inboxes: tuple[dict[str, Any], ...]
    frames: tuple[CoreFrames, ...]
    notes: tuple[str, ...]
    uncounted: dict[str, str]

    @classmethod
    def from_rack(
        cls,
        rack: RackTiming,
        has_cores: bool = True,
        uncounted: Mapping[str, str] = MappingProxyType({}),
    ) -> Forecast:
        """Compute the forecast of a rack.

        Args:
            rack: Data of the rack.
            has_cores: False if this machine lacks cores that the config requests.
            uncounted: What the timing model cannot include, each with the reason.
        """
        return cls(
            rack=rack,
            system=predict_response(rack),
            verdicts=tuple(evaluate_rack(rack)),
            inboxes=tuple(
                inbox.to_document(rack.compute_interrupted_ns(name))
                for name, inbox in rack.inboxes.items()
            ),
            frames=compute_core_frames(rack),
            notes=tuple(_list_notes(rack, has_cores)),
            uncounted={**_list_uncounted(rack), **uncounted},
        )

    @property
    def holds(self) -> bool:
        """Whether all verdicts hold."""
        return all(verdict.holds for verdict in self.verdicts)

    def to_document(self) -> dict[str, Any]:
        """Return the forecast as plain data for JSON. Keys ending in `_ns` are wall-clock times."""
        rack = self.rack
        schedule = None
        if rack.schedule is not None:
            minor_ms, major_ms = (ticks * rack.tick_ns * 1e-6 for ticks in rack.schedule)
            cores = [frames.to_document() for frames in self.frames]
            schedule = {"minor_ms": minor_ms, "major_ms": major_ms, "cores": cores}
        return {
            **asdict(self.system),
            "context_switch_ns": rack.context_switch_ns,
            "levels": [level.to_document() for level in rack.levels.values()],
            "verdicts": [verdict.to_document() for verdict in self.verdicts],
            "responses": [response.to_document() for response in rack.responses],
            "loads": {str(core): load for core, load in rack.loads.items()},
            "inboxes": list(self.inboxes),
            "schedule": schedule,
            "notes": list(self.notes),
            "holds": self.holds,
        }


def _list_uncounted(rack: RackTiming) -> dict[str, str]:
    """Return the tasks that the forecast does not include, each with the reason."""
    counted = {task.name for task in rack.tasks if task.cost_ns}
    # The forecast omits a planner without a planning time, even if its budget has an update time.
    counted -= {f"{b.name}.planner" for b in rack.boards.values() if not b.is_plan_budgeted}
    reasons = {name: NO_BUDGET for name in rack.cores if name not in counted}
    if rack.clock.name in reasons:
        reasons[rack.clock.name] = "timing.clock_ms is 0; --set timing.clock_ms=0.1 counts 0.1 ms"
    return reasons


def _list_notes(rack: RackTiming, has_cores: bool) -> Iterator[str]:
    """Yield a sentence for each limit of the prediction."""
    if words := {task.scheduler.word for task in rack.tasks} - {Scheduler.FIXED_PRIORITY.word}:
        yield f"response times are those of the whole schedule by {' and '.join(sorted(words))}"
    if queues := [
        queue for rank in rack.ranks for name in rank for queue in rack.boards[name].queues
    ]:
        yield f"the system response assumes that these queues are empty: {', '.join(queues)}"
    if rack.inboxes:
        yield (
            "the system response does not include waits of messages for interrupt service:"
            f" {', '.join(rack.inboxes)}"
        )
    known = [board for board in rack.boards.values() if board.budget is not None]
    if known and rack.is_lockstep:
        yield (
            "in lockstep a tick waits for late tasks, unless timing.lockstep_load is set; these are"
            " the times of the same rack in real time"
        )
    if known and rack.speed != 1.0:
        yield (f"times are wall-clock times: speed {rack.speed:g} changes cycles but not budgets")
    if known and not has_cores:
        yield "cores are those in the config; this machine does not have all of them"
    sharing = [task for task in rack.tasks if task.cost_ns and not task.priority]
    crowded = [
        task.name for task in sharing if sum(other.core == task.core for other in sharing) > 1
    ]
    if crowded:
        yield (
            "ordinary scheduling guarantees nothing; these bounds assume fair turns:"
            f" {', '.join(crowded)}"
        )
