"""Every equation twice: predicted from the budgets of the config, and as the run was."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import rack_timing
from rack.levels.timing.equations import Relation, system_response_bound_ns
from rack.levels.timing.verdicts import LOAD, ORDER, RESPONSE_TIME, SYSTEM, EquationVerdict, verdicts
from rack.tools.analysis.cycles import Cycles
from rack.tools.analysis.measured_budgets import WORST, budgets_of, worst_of
from rack.tools.analysis.model import Model
from rack.tools.analysis.rules import response_ns, steps_ns
from rack.tools.analysis.tasks import core_loads
from rack.tools.recording import Recording
from rack.tools.reporting.response import system_response

OBSERVED = ("3.2", "3.3", "3.7", RESPONSE_TIME, LOAD)
"""What a run shows by itself, so that it need not be worked out from the times of its levels."""


@dataclass(frozen=True)
class Pair:
    """One equation put to one subject. `predicted` is None without a budget, `measured` where a run cannot show it."""

    equation: str
    subject: str
    predicted: EquationVerdict | None
    measured: EquationVerdict | None

    @property
    def disagrees(self) -> bool:
        """Whether the run went otherwise than was predicted."""
        if self.predicted is None or self.measured is None:
            return False
        # A core that would have to do too much does what it can: its load is not seen to be too much.
        is_full = self.equation == LOAD and not self.predicted.holds
        return self.predicted.holds != self.measured.holds and not is_full

    @property
    def fails(self) -> bool:
        """Whether the equation did not hold in the run."""
        return self.measured is not None and not self.measured.holds


def compare(
    recording: Recording, config: RackConfig, found: Mapping[str, Cycles], percentile: float = WORST
) -> list[Pair]:
    """Return every equation on everything, in the order of the equations; `found` is what `cycles_of` gave."""
    layout, model = recording.layout, Model.of(config, recording.layout)
    worked_out = verdicts(rack_timing(config, layout, budgets_of(found, percentile)))
    measured = [verdict for verdict in worked_out if verdict.equation not in OBSERVED]
    measured += [*_system(recording, config, model), *_tasks(found, model, percentile)]
    measured += _cores(core_loads(recording, found, model))
    sides = [_by_key(verdicts(rack_timing(config, layout))), _by_key(measured)]
    pairs = [Pair(*key[:2], *(side.get(key) for side in sides)) for key in dict.fromkeys([*sides[0], *sides[1]])]
    return sorted(pairs, key=lambda pair: ORDER.index(pair.equation))


def _by_key(found: list[EquationVerdict]) -> dict[tuple[str, str, str], EquationVerdict]:
    # The system's response is judged down and up, and eq. 3.7 of a config is another question than of a run.
    return {(v.equation, v.subject, v.meaning if v.equation in ("3.2", "3.3", "3.7") else ""): v for v in found}


def _system(recording: Recording, config: RackConfig, model: Model) -> Iterator[EquationVerdict]:
    """Put the longest response of the run to eq. 3.2, and to the sum of eq. 3.3 with its waits for the grid."""
    response = system_response(recording, config, recording.layout)
    if response is None:
        return
    # The report tells simulated time.
    wall_ns = 1e6 * model.tick_ns / recording.layout.clock_ns
    goal_ms = config.timing.response_ms
    bound = system_response_bound_ns([model.cycles[name] * model.tick_ns for name in model.levels])
    bound, meant = (bound, "n R_max") if goal_ms is None else (goal_ms * wall_ns, "timing.response_ms")
    for way in ("command", "status"):
        if (times := response[way]["measured_ms"]) is None:
            continue
        longest_ns, bound_ns = times["max"] * wall_ns, response[way]["bound_ms"] * wall_ns
        meaning = f"R_s of a {way} with its waits for the grid <= {meant}"
        yield EquationVerdict.of("3.2", SYSTEM, Relation(longest_ns, "<=", bound), meaning)
        meaning = f"R_s of a {way} <= sum of R_i and of the waits for the grid"
        yield EquationVerdict.of("3.3", SYSTEM, Relation(longest_ns, "<=", bound_ns), meaning)


def _tasks(found: Mapping[str, Cycles], model: Model, percentile: float) -> Iterator[EquationVerdict]:
    for name, cycles in found.items():
        if cycles.task.role == "executor":
            step = worst_of(steps_ns(cycles, model)[cycles.is_judged], percentile)
            relation = Relation(step, "=", model.cycle_ns(cycles.task))
            yield EquationVerdict.of("3.7", name, relation, "t_(k+1) - t_k = R_i")
        if not model.is_lockstep:
            worst = worst_of(response_ns(cycles, model)[cycles.is_judged], percentile)
            relation = Relation(worst, "<=", model.slice_ns(cycles.task))
            yield EquationVerdict.of(RESPONSE_TIME, name, relation, "measured response <= deadline")


def _cores(loads: Mapping[int, float]) -> Iterator[EquationVerdict]:
    for core, load in loads.items():
        relation = Relation(load, "<=", 1.0)
        yield EquationVerdict.of(LOAD, f"core {core}", relation, "what its tasks used of its time", "1")
