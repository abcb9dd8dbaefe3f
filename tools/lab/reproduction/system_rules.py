"""Rules that derive the verdicts on the systems of section 4.1 from their whole tasks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise

from rack.boards.config import load, resolve_layout
from rack.tools.lab.reproduction.experiments.tasks import TableRuns, TaskRun
from rack.tools.lab.reproduction.rules import check_done
from rack.tools.lab.reproduction.verdict import (
    MAX_STRAY_SHARE,
    Check,
    ClaimVerdict,
    check_none,
    compare_value,
    rule_on,
)

ROUNDING_MS = 1e-6
MAX_RATE_RATIO = 1.2
"""Largest ratio of the cycles of two levels at one rate, which missed cycles change."""


def judge_systems(names: Iterable[str], *records: TaskRun | TableRuns) -> ClaimVerdict:
    """Check that the response of each system, measured in its whole task, is within its bound.

    If a response is longer, the claim still holds within bounds, provided that every response
    beyond the bound was delayed by a missed cycle.

    Args:
        names: Names of the systems.
        records: Record of each system's whole task.
    """
    runs = _key_runs(names, records)
    ways = {
        f"{name}_{way}_ms": response
        for name, run in runs.items()
        if run.response is not None
        for way, response in run.response.ways.items()
        if response.longest_ms is not None
    }
    return rule_on(
        *check_done(*runs.values()),
        ideal=[
            compare_value(name, way.longest_ms or 0.0, "<=", way.bound_ms + ROUNDING_MS)
            for name, way in ways.items()
        ],
        here=check_none(late_without_miss=sum(way.unexplained for way in ways.values())),
    )


def judge_layers(names: Iterable[str], *records: TaskRun | TableRuns) -> ClaimVerdict:
    """Check that each system ran at least two levels, none of them faster than a level below it.

    Args:
        names: Names of the systems.
        records: Record of each system's whole task.
    """
    levels = {name: run.levels for name, run in _key_runs(names, records).items()}
    faster = sum(
        upper > MAX_RATE_RATIO * lower
        for cycles in levels.values()
        for upper, lower in pairwise(cycles)
    )
    counts = (
        compare_value(f"{name}_levels", len(cycles), ">=", 2) for name, cycles in levels.items()
    )
    return rule_on(*counts, *check_none(levels_faster_than_one_below=faster))


def _key_runs(names: Iterable[str], records: Iterable[TaskRun | TableRuns]) -> dict[str, TaskRun]:
    """Return the whole task of each system, keyed by its name."""
    return {
        name: run.disturbed if isinstance(run, TableRuns) else run
        for name, run in zip(names, records, strict=True)
    }


def judge_system(
    rates_hz: Mapping[str, int],
    at_least: Mapping[str, float],
    at_most: Mapping[str, float],
    run: TaskRun,
    ideal: Sequence[Check] = (),
) -> ClaimVerdict:
    """Check the mechanism of a system, and that its parts exchange as many messages as they should.

    Args:
        rates_hz: Rate of each mailbox, Hz. 1 requires at least one message.
        at_least: Smallest permitted values of measurements of the mechanism.
        at_most: Largest permitted values.
        run: Whole task of the system.
        ideal: Further comparisons. If one fails, the claim holds only within bounds.
    """
    min_counts = {
        box: (1.0 - MAX_STRAY_SHARE) * rate_hz * run.lasted_s if rate_hz > 1 else 1
        for box, rate_hz in rates_hz.items()
    }
    return rule_on(
        *check_done(run),
        compare_value("missed_share", run.missed, "<=", MAX_STRAY_SHARE),
        *(
            compare_value(f"{box}_messages", run.messages.get(box, 0), ">=", count)
            for box, count in min_counts.items()
        ),
        *(
            compare_value(name, run.mechanism[name], sign, demanded)
            for sign, values in ((">=", at_least), ("<=", at_most))
            for name, demanded in values.items()
        ),
        ideal=ideal,
    )


def judge_rccl(
    rates_hz: Mapping[str, int],
    at_least: Mapping[str, float],
    at_most: Mapping[str, float],
    run: TaskRun,
) -> ClaimVerdict:
    """Apply `judge_system` to RCCL, and also check that every joint has a separate processor.

    If joints share processors, the claim holds only within bounds.
    """
    joints = [
        task.core for task in resolve_layout(load("rccl")).tasks if task.board.startswith("joint")
    ]
    cores = compare_value("processors_of_joints", len(set(joints)), ">=", len(joints))
    return judge_system(rates_hz, at_least, at_most, run, [cores])
