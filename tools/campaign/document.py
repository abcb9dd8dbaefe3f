"""A campaign as one document: campaign.json, from which the text and the plot are made."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict
from typing import Any

from rack.tools.campaign.campaign import Campaign
from rack.tools.campaign.results import Finding, Results
from rack.tools.campaign.shape import SIZED, judged_size
from rack.tools.campaign.statistics import by_kind, curve, rate, totals

Document = dict[str, Any]


def document(campaign: Campaign, results: Results, wall_s: float) -> Document:
    """Return everything that a campaign has found, as plain data; `shortfalls` is empty when nothing falls short."""
    order, clock_ns = campaign.order, campaign.layout.clock_ns
    kinds = by_kind(results.faults, clock_ns)
    for kind, figures in kinds.items():
        with_it = [run for run in results.trials if any(f.kind == kind and f.struck >= 0 for f in run.faults)]
        figures["trials"] = len(with_it)
        figures["tasks_done"] = sum(run.ended == "task done" for run in with_it)
    summary = _summary(results, 1e9 / clock_ns)
    return {
        "config": order.name,
        "seed": order.seed,
        "modes": ["lockstep" if mode else "realtime" for mode in order.modes],
        "kinds": campaign.kinds,
        "interrupted": results.is_interrupted,
        "wall_s": round(wall_s, 1),
        "machine": _machine(results),
        "clock_ms": clock_ns * 1e-6,
        "nominal": _nominal(results.nominal, clock_ns),
        "summary": summary,
        "by_kind": kinds,
        "sizes": _sizes(results, clock_ns),
        "faultless": [part.document() for part in results.faultless],
        "faults": [
            {"trial": run.plan.number, "lockstep": run.plan.lockstep, **asdict(fault)}
            for run in results.trials
            for fault in run.faults
        ],
        "trials": [_trial(run) for run in results.trials],
        "shortfalls": _shortfalls(results),
    }


def _summary(results: Results, second: float) -> Document:
    trials, runs = results.trials, results.runs
    ended = [run.ended for run in trials]
    calm_s = sum(part.seconds for part in results.faultless)
    trips = sum(part.trips for part in results.faultless)
    simulated_s = sum(run.ticks for run in runs) / second
    unexplained = sum(len(run.unexplained) for run in runs)
    return {
        **totals(results.faults),
        "trials": len(trials),
        "tasks_done": ended.count("task done"),
        "safely_stopped": ended.count("safely stopped"),
        "not_armed": ended.count("not armed"),
        "neither": ended.count("neither"),
        "limits_violated": sum(run.violations for run in runs),
        "touches": sum(run.touches for run in runs),
        "left_behind": sum(len(run.left) for run in runs),
        "simulated_s": round(simulated_s, 1),
        "unexplained": unexplained,
        "unexplained_per_hour": rate(unexplained, simulated_s),
        "stray_misses": sum(run.stray_misses for run in trials if not run.plan.lockstep),
        "false_trips": trips,
        "faultless_s": round(calm_s, 1),
        "false_trips_per_hour": rate(trips, calm_s),
    }


def _shortfalls(results: Results) -> list[str]:
    """Return what fails the campaign, a line each."""
    return [*(f"{_run_of(run)}: {line}" for run in results.runs for line in run.shortfalls), *results.lacking]


def _run_of(run: Finding) -> str:
    return f"trial {run.plan.number}" if run.plan.number else f"{run.plan.purpose} run"


def _sizes(results: Results, clock_ns: int) -> Document:
    swept = [fault for run in results.sizes for fault in run.faults] + results.faults
    curves = {kind: curve(swept, kind, clock_ns) for kind in SIZED}
    return {kind: {"judged_from": judged_size(kind), "curve": points} for kind, points in curves.items() if points}


def _nominal(run: Finding, clock_ns: int) -> Document:
    return {"ticks": run.ticks, "seconds": round(run.ticks * clock_ns * 1e-9, 3), "digest": run.digest}


def _trial(run: Finding) -> Document:
    return {
        "number": run.plan.number,
        "purpose": run.plan.purpose,
        "lockstep": run.plan.lockstep,
        "faults": len(run.faults),
        "ended": run.ended,
        "wall_s": round(run.wall_s, 1),
        "shortfalls": list(run.shortfalls),
    }


def _machine(results: Results) -> Document:
    # In lockstep trials are kept to a core each, and say so.
    notes = [note for run in results.runs if not run.plan.lockstep for note in run.notes]
    return {
        "cores": len(os.sched_getaffinity(0)),
        "kernel": platform.release(),
        "python": platform.python_version(),
        "notes": list(dict.fromkeys(notes)),
    }
