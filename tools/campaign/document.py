"""A campaign as one document: campaign.json, from which the text and the plot are made."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict
from typing import Any

from tools.campaign.campaign import Campaign
from tools.campaign.results import Judged, Results
from tools.campaign.shape import SIZED, judged_size
from tools.campaign.statistics import by_kind, curve, totals

Document = dict[str, Any]


def document(campaign: Campaign, results: Results, wall_s: float) -> Document:
    """Return everything that a campaign has found, as plain data; `shortfalls` is empty when nothing falls short."""
    order, clock_ns = campaign.order, campaign.layout.clock_ns
    kinds = by_kind(results.faults, clock_ns)
    for kind, figures in kinds.items():
        with_it = [j for j in results.trials if any(f.kind == kind and f.struck >= 0 for f in j.verdict.faults)]
        figures["trials"] = len(with_it)
        figures["tasks_done"] = sum(judged.ended == "task done" for judged in with_it)
    summary = _summary(results)
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
            {"trial": judged.trial.plan.number, "lockstep": judged.trial.plan.lockstep, **asdict(fault)}
            for judged in results.trials
            for fault in judged.verdict.faults
        ],
        "trials": [_trial(judged) for judged in results.trials],
        "shortfalls": _shortfalls(results, summary),
    }


def _summary(results: Results) -> Document:
    trials = results.trials
    ended = [judged.ended for judged in trials]
    calm_s = sum(part.seconds for part in results.faultless)
    trips = sum(part.trips for part in results.faultless)
    return {
        **totals(results.faults),
        "trials": len(trials),
        "tasks_done": ended.count("task done"),
        "safely_stopped": ended.count("safely stopped"),
        "not_armed": ended.count("not armed"),
        "neither": ended.count("neither"),
        "limits_violated": sum(judged.trial.arm.violations for judged in results.runs),
        "touches": sum(judged.trial.arm.touches for judged in results.runs),
        "left_behind": sum(len(judged.trial.left) for judged in results.runs),
        "unexplained": sum(len(judged.verdict.unexplained) for judged in (results.nominal, *trials, *results.sizes)),
        "false_trips": trips,
        "faultless_s": round(calm_s, 1),
        "false_trips_per_hour": round(trips * 3600.0 / calm_s, 3) if calm_s else None,
    }


def _shortfalls(results: Results, summary: Document) -> list[str]:
    """Return what fails the campaign, a line each."""
    found = [f"{_run_of(judged)}: {line}" for judged in results.runs for line in judged.shortfalls]
    if summary["drawn"] and not summary["injected"]:
        found.append(f"none of the {summary['drawn']} faults that were drawn has struck")
    return found


def _run_of(judged: Judged) -> str:
    plan = judged.trial.plan
    return f"trial {plan.number}" if plan.number else f"{plan.purpose} run"


def _sizes(results: Results, clock_ns: int) -> Document:
    swept = [fault for judged in results.sizes for fault in judged.verdict.faults] + results.faults
    curves = {kind: curve(swept, kind, clock_ns) for kind in SIZED}
    return {kind: {"judged_from": judged_size(kind), "curve": points} for kind, points in curves.items() if points}


def _nominal(judged: Judged, clock_ns: int) -> Document:
    outcome = judged.trial.outcome
    ticks = outcome.ticks if outcome else 0
    return {"ticks": ticks, "seconds": round(ticks * clock_ns * 1e-9, 3), "digest": outcome.digest if outcome else ""}


def _trial(judged: Judged) -> Document:
    plan = judged.trial.plan
    return {
        "number": plan.number,
        "purpose": plan.purpose,
        "lockstep": plan.lockstep,
        "faults": len(judged.verdict.faults),
        "ended": judged.ended,
        "wall_s": round(judged.trial.wall_s, 1),
        "shortfalls": judged.shortfalls,
    }


def _machine(results: Results) -> Document:
    notes = [e.text for j in results.runs for e in j.trial.events if e.kind == "ready"]
    return {
        "cores": len(os.sched_getaffinity(0)),
        "kernel": platform.release(),
        "python": platform.python_version(),
        "notes": list(dict.fromkeys(notes)),
    }
