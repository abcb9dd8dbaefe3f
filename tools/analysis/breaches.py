"""Which cycle broke which equation: each by its own numbers.

A budget holds the worst of all cycles against an equation; here every cycle is held against it by itself. So a level
may fail eq. 3.6, whose longest execution and longest communication need not have met, without a cycle that did.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from rack.tools.analysis.company import Company, companies
from rack.tools.analysis.cycles import Cycles
from rack.tools.analysis.model import Model
from rack.tools.analysis.rules import Rule, response_ns, rules_for, steps_ns


@dataclass(frozen=True)
class Broken:
    """An equation that a cycle broke, with both sides in ns; as parts of a cycle where `unit` is "1"."""

    equation: str
    left: float
    sign: str
    right: float
    unit: str


@dataclass(frozen=True)
class Breach:
    """A cycle that broke equations. `excess` is by how much, as a multiple of the time that it had; to sort by."""

    task: str
    tick: int
    broken: tuple[Broken, ...]
    excess: float
    is_start_up: bool
    company: Company


def breaches(found: Mapping[str, Cycles], model: Model) -> list[Breach]:
    """Return the cycles that broke an equation by their own numbers, the worst first."""
    all_of_them = [breach for name in found for breach in _breaches_of(name, found, model)]
    return sorted(all_of_them, key=lambda breach: (-breach.excess, breach.tick))


def _breaches_of(name: str, found: Mapping[str, Cycles], model: Model) -> Iterator[Breach]:
    cycles = found[name]
    count, rules = len(cycles.rows), rules_for(name, found, model)
    if not rules:
        return
    fails = np.array([~np.broadcast_to(rule.relation.holds, count) for rule in rules])
    at = np.flatnonzero(fails.any(axis=0))
    excess, due_ns = _excess(cycles, model), _due_ns(cycles, model)
    for row, company in zip(at, companies(name, at, due_ns[at], found, model.critical), strict=True):
        yield Breach(
            task=name,
            tick=int(cycles.rows["tick"][row]),
            broken=tuple(
                _broken(rule, int(row), count) for rule, failed in zip(rules, fails[:, row], strict=True) if failed
            ),
            excess=float(excess[row]),
            is_start_up=not cycles.is_judged[row],
            company=company,
        )


def _broken(rule: Rule, row: int, count: int) -> Broken:
    left, sign, right = rule.relation
    return Broken(
        rule.equation,
        float(np.broadcast_to(left, count)[row]),
        sign,
        float(np.broadcast_to(right, count)[row]),
        rule.unit,
    )


def _due_ns(cycles: Cycles, model: Model) -> np.ndarray:
    """Return since when each cycle was due: its release, or the first of those that it skipped, shape (n,)."""
    release = cycles.rows["release_ns"]
    if model.is_lockstep or cycles.task.role == "planner":
        return np.asarray(release)
    return np.asarray(release + model.cycle_ns(cycles.task) - steps_ns(cycles, model))


def _excess(cycles: Cycles, model: Model) -> np.ndarray:
    slice_ns = model.slice_ns(cycles.task)
    excess = cycles.used_ns / slice_ns
    if model.is_lockstep:
        return excess
    excess = np.maximum(excess, response_ns(cycles, model) / slice_ns)
    return np.maximum(excess, steps_ns(cycles, model) / slice_ns) if cycles.task.role == "executor" else excess
