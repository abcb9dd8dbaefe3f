"""All predictions of the timing model for a rack before it is launched."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

from rack.boards.timing.frames import CoreFrames, core_frames
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.system_response import Prediction, predict
from rack.boards.timing.verdicts import EquationVerdict, verdicts

NO_BUDGET = "no budget"


@dataclass(frozen=True)
class Forecast:
    """The timing of a rack from its budgets. `notes` are the limits of the prediction; `uncounted`
    gives for every board, planner and host board that it leaves out the reason.

    `inboxes` are what interrupts cost each board, as `InboxTiming.document` returns it. `frames`
    are what cores do in the frames of a static schedule.
    """

    rack: RackTiming
    system: Prediction
    verdicts: tuple[EquationVerdict, ...]
    inboxes: tuple[dict[str, Any], ...]
    frames: tuple[CoreFrames, ...]
    notes: tuple[str, ...]
    uncounted: dict[str, str]

    @classmethod
    def of(cls, rack: RackTiming, has_cores: bool = True, hosts: Iterable[str] = ()) -> Forecast:
        """Return the forecast of a rack.

        Args:
            rack: Timing of the boards.
            has_cores: False if this machine lacks cores that the config asks for.
            hosts: Host boards, which the timing model does not know.
        """
        return cls(
            rack=rack,
            system=predict(rack),
            verdicts=tuple(verdicts(rack)),
            inboxes=tuple(
                inbox.document(rack.slice_ticks(name) * rack.clock_ns)
                for name, inbox in rack.inboxes.items()
            ),
            frames=core_frames(rack),
            notes=tuple(_notes(rack, has_cores)),
            uncounted=_uncounted(rack) | dict.fromkeys(hosts, "a host board, without a rate"),
        )

    @property
    def holds(self) -> bool:
        """Whether every verdict holds."""
        return all(verdict.holds for verdict in self.verdicts)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data; times whose names end in _ns are wall-clock times."""
        rack = self.rack
        schedule = None
        if rack.schedule is not None:
            minor_ms, major_ms = (ticks * rack.tick_ns * 1e-6 for ticks in rack.schedule)
            cores = [found.document() for found in self.frames]
            schedule = {"minor_ms": minor_ms, "major_ms": major_ms, "cores": cores}
        return {
            **asdict(self.system),
            "context_switch_ns": rack.context_switch_ns,
            "levels": [level.document() for level in rack.levels.values()],
            "verdicts": [verdict.document() for verdict in self.verdicts],
            "responses": [response.document() for response in rack.responses],
            "loads": {str(core): load for core, load in rack.loads.items()},
            "inboxes": list(self.inboxes),
            "schedule": schedule,
            "notes": list(self.notes),
            "holds": self.holds,
        }


def _uncounted(rack: RackTiming) -> dict[str, str]:
    """Return the tasks without a cost, with the reason."""
    counted = {task.name for task in rack.tasks if task.cost_ns}
    # An update alone is no plan.
    counted -= {f"{b.name}.planner" for b in rack.boards.values() if not b.is_plan_budgeted}
    found = {name: NO_BUDGET for name in rack.cores if name not in counted}
    if rack.clock.name in found:
        found[rack.clock.name] = "timing.clock_ms is 0; --set timing.clock_ms=0.1 counts 0.1 ms"
    return found


def _notes(rack: RackTiming, has_cores: bool) -> Iterator[str]:
    if queues := [
        queue for rank in rack.ranks for name in rank for queue in rack.boards[name].queues
    ]:
        yield f"the system's response is that of empty queues: {', '.join(queues)}"
    if rack.inboxes:
        yield (
            "the system's response leaves out how long messages wait to be served:"
            f" {', '.join(rack.inboxes)}"
        )
    known = [board for board in rack.boards.values() if board.budget is not None]
    if known and rack.is_lockstep:
        yield (
            "in lockstep a tick waits for late tasks; this is the timing of the same rack in real"
            " time"
        )
    if known and rack.speed != 1.0:
        yield (
            f"times are of the wall clock: speed {rack.speed:g} changes the cycles, not the budgets"
        )
    if known and not has_cores:
        yield "cores are those of the config; this machine lacks some of them"
    sharing = [task for task in rack.tasks if task.cost_ns and not task.priority]
    crowded = [
        task.name for task in sharing if sum(other.core == task.core for other in sharing) > 1
    ]
    if crowded:
        yield (
            "ordinary scheduling guarantees nothing; bounds that assume fair turns:"
            f" {', '.join(crowded)}"
        )
