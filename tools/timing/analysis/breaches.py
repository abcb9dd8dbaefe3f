"""Cycles that broke an equation by their own numbers, and the tasks that shared their core
meanwhile.

A budget compares the worst of all cycles with an equation; here every cycle is compared by itself.
A level may therefore fail eq. 3.6, whose longest execution and longest communication need not fall
into one cycle, without a cycle that breaks it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from rack.levels.timing.rack import RackTiming
from rack.levels.timing.trace_times import Occupation
from rack.tools.recording.cycles import Cycles
from rack.tools.timing.analysis.rules import (
    Rule,
    cycle_ns,
    response_ns,
    rules_for,
    slice_ns,
    steps_ns,
)

MENTIONED = 0.1
"""Part of a cycle's time from which on the text mentions its cause."""
BEFORE = "the cycle before"
UNUSUAL = 1.5
"""Multiple of the usual processor time from which on a cycle is said to have computed long."""


@dataclass(frozen=True)
class CoreSharing:
    """The use of the core from the time a cycle was due until its end, ns.

    `own_ns` is the cycle's own processor time, `usual_ns` the median of that over all cycles: a
    virtual machine stalled by its host counts the stall as own time. `others_ns` are the tasks of
    the rack that kept it from the core. `nobody_ns` is in no trace: the clock's and the kernel's
    own work, or other programs.
    """

    lasted_ns: int
    own_ns: int
    usual_ns: int
    others_ns: Mapping[str, int]
    nobody_ns: int

    def text(self) -> str:
        """Return the main uses of the time, the longest first."""
        uses = sorted(self._uses(), reverse=True)
        return (
            "; ".join(text for _, text in uses) or f"computed {brief_ms(self.own_ns)} ms, as usual"
        )

    def _uses(self) -> Iterator[tuple[int, str]]:
        least = MENTIONED * self.lasted_ns
        if self.own_ns > UNUSUAL * self.usual_ns:
            yield (
                self.own_ns,
                f"computed {brief_ms(self.own_ns)} ms, usually {brief_ms(self.usual_ns)} ms",
            )
        for name, ns in self.others_ns.items():
            if ns > least:
                what = "its previous cycle" if name == BEFORE else name
                yield (ns, f"{what} had the core for {brief_ms(ns)} ms")
        if self.nobody_ns > least:
            yield (
                self.nobody_ns,
                f"no task of the rack had the core for {brief_ms(self.nobody_ns)} ms",
            )


@dataclass(frozen=True)
class Broken:
    """An equation that a cycle broke, both sides in ns, or in parts of a cycle where `unit` is
    "1"."""

    equation: str
    left: float
    sign: str
    right: float
    unit: str


@dataclass(frozen=True)
class Breach:
    """A cycle that broke equations. `excess` is its overrun as a multiple of the time available,
    for sorting.

    `is_judged` excludes what `Cycles.is_judged` does."""

    task: str
    tick: int
    broken: tuple[Broken, ...]
    excess: float
    is_judged: bool
    sharing: CoreSharing


def breaches(found: Mapping[str, Cycles], rack: RackTiming) -> list[Breach]:
    """Return the cycles that broke an equation by their own numbers, the worst first."""
    all_of_them = [breach for name in found for breach in _breaches_of(name, found, rack)]
    return sorted(all_of_them, key=lambda breach: (-breach.excess, breach.tick))


def _breaches_of(name: str, found: Mapping[str, Cycles], rack: RackTiming) -> Iterator[Breach]:
    cycles = found[name]
    count = len(cycles.rows)
    rules = rules_for(name, found, rack)
    if not rules:
        return
    fails = np.array([~np.broadcast_to(rule.relation.holds, count) for rule in rules])
    at = np.flatnonzero(fails.any(axis=0))
    excess = _excess(cycles, rack)
    for row, sharing in zip(at, _sharing(name, at, found, rack), strict=True):
        yield Breach(
            task=name,
            tick=int(cycles.rows["tick"][row]),
            broken=tuple(
                _broken(rule, int(row), count)
                for rule, failed in zip(rules, fails[:, row], strict=True)
                if failed
            ),
            excess=float(excess[row]),
            is_judged=bool(cycles.is_judged[row]),
            sharing=sharing,
        )


def _broken(rule: Rule, row: int, count: int) -> Broken:
    left, sign, right = rule.relation
    left, right = (float(np.broadcast_to(side, count)[row]) for side in (left, right))
    return Broken(rule.equation, left, sign, right, rule.unit)


def _due_ns(cycles: Cycles, rack: RackTiming) -> np.ndarray:
    """Return the time from which on each cycle was due: its release, or the first that was skipped
    before it."""
    release = cycles.rows["release_ns"]
    if rack.is_lockstep or cycles.task.role == "planner":
        return np.asarray(release)
    return np.asarray(release + cycle_ns(rack, cycles.task) - steps_ns(cycles, rack))


def _excess(cycles: Cycles, rack: RackTiming) -> np.ndarray:
    available_ns = slice_ns(rack, cycles.task)
    excess = cycles.used_ns / available_ns
    if rack.is_lockstep:
        return excess
    excess = np.maximum(excess, response_ns(cycles, rack) / available_ns)
    return (
        np.maximum(excess, steps_ns(cycles, rack) / available_ns)
        if cycles.task.role == "executor"
        else excess
    )


def _sharing(
    name: str, at: np.ndarray, found: Mapping[str, Cycles], rack: RackTiming
) -> list[CoreSharing]:
    """Return the use of the core in the cycles of a task at the places `at`, shape (n,)."""
    cycles = found[name]
    rows = cycles.rows[at]
    starts = _due_ns(cycles, rack)[at]
    ends = rows["end_ns"]
    others = {
        other: rival
        for other, rival in found.items()
        if other != name and rival.core == cycles.core
    }
    # By their priorities, these can have had the core while this task wanted it.
    rivals = {
        o: Occupation.of(rival.rows)
        for o, rival in others.items()
        if rival.priority >= cycles.priority
    }
    # A plan update that is a critical section keeps the executor waiting.
    if (
        rack.boards[cycles.task.board].is_critical
        and (planner := found.get(f"{name}.planner")) is not None
    ):
        rivals[planner.task.name] = Occupation(planner.rows["process_ns"], planner.rows["end_ns"])
    kept = {other: occupied.within(starts, ends) for other, occupied in rivals.items()}
    together = Occupation.union(list(rivals.values())).within(starts, ends)
    # A release may come while the cycle before it is still running.
    begins = np.maximum(starts, rows["start_ns"] - cycles.overhead_ns)
    kept[BEFORE] = before = Occupation.of(cycles.rows).within(starts, begins)
    lasted = ends - starts
    own = cycles.used_ns[at]
    # Ordinary scheduling divides a core among all that want it: others had no more than the rest.
    left = np.clip(lasted - own, 0, None)
    nobody = np.clip(left - together - before, 0, None)
    usual = int(np.median(cycles.used_ns))
    return [
        CoreSharing(
            lasted_ns=int(lasted[row]),
            own_ns=int(own[row]),
            usual_ns=usual,
            others_ns={
                other: int(min(ns[row], left[row])) for other, ns in kept.items() if ns[row]
            },
            nobody_ns=int(nobody[row]),
        )
        for row in range(len(at))
    ]


def brief_ms(ns: float) -> str:
    """Return a time in ms with three digits."""
    ms = ns * 1e-6
    return f"{ms:.0f}" if ms >= 100 else f"{ms:.3g}"
