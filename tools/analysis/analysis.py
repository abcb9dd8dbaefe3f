"""A run compared with the timing model: every equation twice, predicted from the budgets and as measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from rack.boards.config import RackConfig
from rack.boards.config.timing import budgets
from rack.levels.timing.equations import system_response_bound_ns
from rack.levels.timing.relation import Relation
from rack.tools.analysis.breaches import Breach, breaches
from rack.tools.analysis.model import Model, response_ns, steps_ns
from rack.tools.answer import Failure
from rack.tools.runs.cycles import WORST, Cycles, budgets_of, cycles_of, worst_of
from rack.tools.runs.measured_response import system_response
from rack.tools.runs.recording import Recording
from rack.tools.timing.level_timing import LevelTiming, level_timings
from rack.tools.timing.verdict import Verdict
from rack.tools.timing.verdicts import BEYOND, EQUATIONS, LOAD, RESPONSE_TIME, SYSTEM, verdicts

MOSTLY = 99.0
"""Percentile for the question whether a level fails in most of its cycles."""
OBSERVED = ("3.2", "3.3", "3.7", RESPONSE_TIME, LOAD)
"""Equations that a run shows directly; the others follow from the times of its levels."""
ORDER = (*EQUATIONS, *BEYOND)


@dataclass(frozen=True)
class Pair:
    """One equation put to one subject. `predicted` is None without a budget, `measured` if a run cannot show it."""

    equation: str
    subject: str
    predicted: Verdict | None
    measured: Verdict | None

    @property
    def disagrees(self) -> bool:
        """Whether the run contradicts the prediction."""
        if self.predicted is None or self.measured is None:
            return False
        # The measured load of an overloaded core stays below 1.
        is_full = self.equation == LOAD and not self.predicted.holds
        return self.predicted.holds != self.measured.holds and not is_full

    @property
    def fails(self) -> bool:
        """Whether the equation failed in the run."""
        return self.measured is not None and not self.measured.holds


@dataclass(frozen=True)
class Analysis:
    """A run compared with the timing model; `predicted` and `measured` are by board, `cycles` and `loads` as measured.

    A level without a budget is missing in `predicted`, one that never ran in `measured`. `pairs` are of the
    `percentile`, `mostly` of the longest of `MOSTLY` in 100 cycles: a level that does not fit fails in most of its
    cycles, a machine that stalls now and then does not. `loads` are by core, as parts of its time.
    """

    recording: Recording
    config: RackConfig
    model: Model
    percentile: float
    cycles: Mapping[str, Cycles]
    loads: Mapping[int, float]
    predicted: Mapping[str, LevelTiming]
    measured: Mapping[str, LevelTiming]
    pairs: tuple[Pair, ...]
    mostly: tuple[Pair, ...]
    breaches: tuple[Breach, ...]

    @classmethod
    def of(
        cls, recording: Recording, percentile: float = WORST, progress: Callable[[float], None] = lambda part: None
    ) -> Analysis:
        """Analyze a recorded run; `progress` takes the part done. Raises `Failure` for an empty or old trace."""
        config, layout = recording.rack_config, recording.layout
        found = cycles_of(recording)
        if not found:
            raise Failure(f"{recording.folder}: no cycle was traced; there is nothing to analyze", 2)
        progress(0.4)
        model = Model.of(config, layout)
        both = (budgets(config), budgets_of(found, percentile))
        predicted, measured = ({t.board: t for t in level_timings(config, layout, budget)} for budget in both)
        loads = core_loads(recording, found, model)
        comparison = _Comparison(recording, config, model, found, loads)
        pairs = comparison.pairs(percentile)
        progress(0.7)
        return cls(
            recording=recording,
            config=config,
            model=model,
            percentile=percentile,
            cycles=found,
            loads=loads,
            predicted=predicted,
            measured=measured,
            pairs=pairs,
            mostly=comparison.pairs(min(percentile, MOSTLY)),
            breaches=tuple(breaches(found, model)),
        )

    @property
    def holds(self) -> bool:
        """Whether every equation held in the run."""
        return not any(pair.fails for pair in self.pairs)

    @property
    def judged_breaches(self) -> tuple[Breach, ...]:
        """The breaches outside the start-up of a process, the worst first."""
        return tuple(breach for breach in self.breaches if not breach.is_start_up)


@dataclass(frozen=True)
class _Comparison:
    """What the equations of a run are compared on; `found` are its cycles by task, `loads` those of its cores."""

    recording: Recording
    config: RackConfig
    model: Model
    found: Mapping[str, Cycles]
    loads: Mapping[int, float]

    def pairs(self, percentile: float) -> tuple[Pair, ...]:
        """Return every equation on every subject, in the order of the equations."""
        config, layout = self.config, self.recording.layout
        worked_out = verdicts(config, layout, budgets_of(self.found, percentile))
        measured = [verdict for verdict in worked_out if verdict.equation not in OBSERVED]
        measured += [*self._system(), *self._tasks(percentile), *self._cores()]
        sides = [_by_key(verdicts(config, layout, budgets(config))), _by_key(measured)]
        pairs = [Pair(*key[:2], *(side.get(key) for side in sides)) for key in dict.fromkeys([*sides[0], *sides[1]])]
        return tuple(sorted(pairs, key=lambda pair: ORDER.index(pair.equation)))

    def _system(self) -> Iterator[Verdict]:
        """Yield eq. 3.2 on the longest response of the run, and eq. 3.3 on the sum with its waits for the grid."""
        response, model = system_response(self.recording), self.model
        if response is None:
            return
        # The response is in simulated time.
        wall_ns = 1e6 * model.tick_ns / self.recording.layout.clock_ns
        goal_ms = self.config.timing.response_ms
        bound = system_response_bound_ns([model.cycles[name] * model.tick_ns for name in model.levels])
        bound, meant = (bound, "n R_max") if goal_ms is None else (goal_ms * wall_ns, "timing.response_ms")
        for way in ("command", "status"):
            if (times := response[way]["measured_ms"]) is None:
                continue
            longest_ns, bound_ns = times["max"] * wall_ns, response[way]["bound_ms"] * wall_ns
            meaning = f"R_s of a {way} with its waits for the grid <= {meant}"
            yield _judged("3.2", SYSTEM, Relation(longest_ns, "<=", bound), meaning)
            meaning = f"R_s of a {way} <= sum of R_i and of the waits for the grid"
            yield _judged("3.3", SYSTEM, Relation(longest_ns, "<=", bound_ns), meaning)

    def _tasks(self, percentile: float) -> Iterator[Verdict]:
        model = self.model
        for name, cycles in self.found.items():
            if cycles.task.role == "executor":
                step = worst_of(steps_ns(cycles, model)[cycles.is_judged], percentile)
                yield _judged("3.7", name, Relation(step, "=", model.cycle_ns(cycles.task)), "t_(k+1) - t_k = R_i")
            if not model.is_lockstep:
                worst = worst_of(response_ns(cycles, model)[cycles.is_judged], percentile)
                relation = Relation(worst, "<=", model.slice_ns(cycles.task))
                yield _judged(RESPONSE_TIME, name, relation, "measured response <= deadline")

    def _cores(self) -> Iterator[Verdict]:
        for core, load in self.loads.items():
            yield _judged(LOAD, f"core {core}", Relation(load, "<=", 1.0), "what its tasks used of its time", "1")


def _by_key(found: list[Verdict]) -> dict[tuple[str, str, str], Verdict]:
    # The system's response is judged down and up; eq. 3.7 asks something else of a config than of a run.
    return {(v.equation, v.subject, v.meaning if v.equation in ("3.2", "3.3", "3.7") else ""): v for v in found}


def _judged(equation: str, subject: str, relation: Relation, meaning: str, unit: str = "ns") -> Verdict:
    return Verdict(equation, subject, *relation, relation.holds, meaning, unit)


def core_loads(recording: Recording, found: Mapping[str, Cycles], model: Model) -> dict[int, float]:
    """Return by core the part of its time that tasks used, without the clock's own.

    An executor counts at all its releases, skipped ones too: so the load of an overloaded core exceeds 1.
    """
    loads: dict[int, float] = {}
    for name, cycles in found.items():
        rows = recording.cycles[name]
        if cycles.task.role == "executor":
            load = float(rows["processor_ns"].mean()) / model.cycle_ns(cycles.task)
        else:
            load = int(rows["processor_ns"].sum()) / _lasted_ns(recording, model)
        loads[cycles.core] = loads.get(cycles.core, 0.0) + load
    return dict(sorted(loads.items()))


def _lasted_ns(recording: Recording, model: Model) -> int:
    """Return the length of the run, ns; in lockstep in simulated time."""
    first = min(int(rows["tick"][0]) for rows in recording.cycles.values())
    last = max(int(rows["tick"][-1]) for rows in recording.cycles.values())
    return (last - first + 1) * model.tick_ns
