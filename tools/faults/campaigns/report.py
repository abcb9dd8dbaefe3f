"""The report of a campaign: one document, campaign.json, and campaign.md for people, made from
it."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from rack.boards.faults.kind import KINDS
from rack.tools.console.tables import markdown_table
from rack.tools.faults.campaigns.campaign import Campaign
from rack.tools.faults.campaigns.results import Results, TrialResult
from rack.tools.faults.campaigns.statistics import by_kind, curve, rate, totals

Report = dict[str, Any]
SHOWN = 30
"""Shortfalls that the text shows; campaign.json has them all."""
KINDS_HEAD = [
    *(
        "kind",
        "injected",
        "detected",
        "in bound",
        "recovered",
        "at least",
        "ticks median",
        "max",
        "bound, ticks",
    ),
    *("ms median", "max", "recovery median, ms", "max", "reactions"),
]

ENDS = {
    "tasks_done": "task done",
    "safely_stopped": "safely stopped",
    "not_armed": "not armed",
    "neither": "neither",
}


def document(campaign: Campaign, results: Results, wall_s: float) -> Report:
    """Return all results of a campaign as plain data; `shortfalls` is empty when nothing falls
    short."""
    order = campaign.order
    clock_ns = campaign.layout.clock_ns
    run = results.nominal
    kinds = by_kind(results.faults, clock_ns)
    for kind, figures in kinds.items():
        with_it = [
            one
            for one in results.trials
            if any(f.kind == kind and f.struck >= 0 for f in one.faults)
        ]
        figures["trials"] = len(with_it)
        figures["tasks_done"] = sum(one.ended == "task done" for one in with_it)
    summary = _figures(results, 1e9 / clock_ns)
    return {
        "config": order.name,
        "seed": order.seed,
        "modes": ["lockstep" if mode else "realtime" for mode in order.modes],
        "kinds": campaign.kinds,
        "interrupted": results.is_interrupted,
        "wall_s": round(wall_s, 1),
        "machine": _machine(results),
        "clock_ms": clock_ns * 1e-6,
        "nominal": {
            "ticks": run.ticks,
            "seconds": round(run.ticks * clock_ns * 1e-9, 3),
            "digest": run.digest,
        },
        "summary": summary,
        "by_kind": kinds,
        "sizes": _curves(results, clock_ns),
        "faultless": [part.document() for part in results.faultless],
        "faults": [
            {"trial": run.plan.number, "lockstep": run.plan.lockstep, **asdict(fault)}
            for run in results.trials
            for fault in run.faults
        ],
        "trials": [_trial(run) for run in results.trials],
        "shortfalls": _shortfalls(results),
    }


def _figures(results: Results, second: float) -> Report:
    trials = results.trials
    runs = results.runs
    ended = Counter[str](run.ended for run in trials)
    calm_s = sum(part.seconds for part in results.faultless)
    trips = sum(part.trips for part in results.faultless)
    simulated_s = sum(run.ticks for run in runs) / second
    unexplained = sum(len(run.unexplained) for run in runs)
    return {
        **totals(results.faults),
        "trials": len(trials),
        **{key: ended[name] for key, name in ENDS.items()},
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
    """Return the reasons why the campaign fails, a line each."""
    names = [
        (run, f"trial {run.plan.number}" if run.plan.number else f"{run.plan.purpose} run")
        for run in results.runs
    ]
    return [
        *(f"{name}: {line}" for run, name in names for line in run.shortfalls),
        *results.lacking,
    ]


def _curves(results: Results, clock_ns: int) -> Report:
    swept = [fault for run in results.sizes for fault in run.faults] + results.faults
    curves = {
        kind: curve(swept, kind.name, clock_ns) for kind in KINDS if kind.visible_from is not None
    }
    return {
        kind.name: {"judged_from": kind.visible_from, "curve": points}
        for kind, points in curves.items()
        if points
    }


def _trial(run: TrialResult) -> Report:
    return {
        "number": run.plan.number,
        "purpose": run.plan.purpose,
        "lockstep": run.plan.lockstep,
        "faults": len(run.faults),
        "ended": run.ended,
        "wall_s": round(run.wall_s, 1),
        "shortfalls": list(run.shortfalls),
    }


def _machine(results: Results) -> Report:
    # Trials in lockstep share a core each, and note it.
    notes = [note for run in results.runs if not run.plan.lockstep for note in run.notes]
    return {
        "cores": len(os.sched_getaffinity(0)),
        "kernel": platform.release(),
        "python": platform.python_version(),
        "notes": list(dict.fromkeys(notes)),
    }


def markdown(report: Report) -> str:
    """Return campaign.md of a campaign's document."""
    return "\n".join(_lines(report)) + "\n"


def _lines(report: Report) -> Iterator[str]:
    summary = report["summary"]
    verdict = "fell short" if report["shortfalls"] else "passed"
    yield f"# Campaign on {report['config']}, seed {report['seed']}: {verdict}"
    yield ""
    yield (
        f"{summary['trials']} trials, {' and '.join(dict.fromkeys(report['modes']))}, in"
        f" {report['wall_s']:.0f} s on "
        f"{report['machine']['cores']} cores, Linux {report['machine']['kernel']}."
        f"{' Interrupted: results until then.' if report['interrupted'] else ''}"
    )
    yield from (f"- {note}" for note in report["machine"]["notes"])
    yield ""
    yield from markdown_table(["", ""], [[name, str(value)] for name, value in _summary(summary)])
    if report["by_kind"]:
        yield from ("", "## Faults by kind", "")
        yield from markdown_table(
            KINDS_HEAD, [_kind_row(kind, figures) for kind, figures in report["by_kind"].items()]
        )
        yield ""
        yield (
            "At least: the smallest lower bound of Wilson's 95 % interval of detected, in bound and"
            " recovered."
        )
    yield from _faultless(report["faultless"])
    yield from _sizes(report["sizes"])
    if shortfalls := report["shortfalls"]:
        yield from (
            "",
            f"## Shortfalls: {len(shortfalls)}",
            "",
            *(f"- {line}" for line in shortfalls[:SHOWN]),
        )


def _summary(summary: Report) -> Iterator[tuple[str, Any]]:
    yield (
        "injected",
        f"{summary['injected']}; {summary['not_struck']} more did not strike and were drawn again",
    )
    yield "detected", summary["detected"]
    yield "within the bound", summary["within_bound"]
    yield "reacted to", summary["reacted_to"]
    latched = (
        f", of which {summary['latched']} ended the task, as permitted"
        if summary["latched"]
        else ""
    )
    yield "recovered from", f"{summary['recovered']}{latched}"
    ends = [f"{summary[key]} {name}" for key, name in ENDS.items() if summary[key]]
    yield "trials ended", ", ".join(ends) or "none"
    yield "limits violated", f"{summary['limits_violated']} (in any substep of any run)"
    yield "touches", summary["touches"]
    yield "left behind", f"{summary['left_behind']} (processes, segments)"
    hours = f"{summary['simulated_s'] / 3600.0:.2f} simulated hours"
    yield (
        "false detections",
        f"{summary['unexplained']} in {hours}: {_rate(summary['unexplained_per_hour'])}",
    )
    if summary["faultless_s"]:
        trips = f"{summary['false_trips']} in {summary['faultless_s']:g} s"
        yield (
            "of these without faults, in real time",
            f"{trips}: {_rate(summary['false_trips_per_hour'])}",
        )
    yield "unexplained misses in real time", summary["stray_misses"]


def _rate(found: Report | None) -> str:
    return (
        "-"
        if found is None
        else f"{found['an_hour']:.3g} an hour, below {found['below']:.3g} with 95 % confidence"
    )


def _kind_row(kind: str, figures: Report) -> list[str]:
    bound = figures["bound_ticks"]
    spans = (
        "-"
        if bound is None
        else "-".join(dict.fromkeys(str(bound[key]) for key in ("least", "most")))
    )
    return [
        kind,
        *(str(figures[key]) for key in ("injected", "detected", "within_bound", "recovered")),
        (
            "-"
            if None in (shares := list(figures["wilson"].values()))
            else f"{min(low for low, _ in shares):.1%}"
        ),
        *_median_max(figures["ticks"]),
        spans,
        *_median_max(figures["ms"]),
        *_median_max(figures["recovery_ms"]),
        ", ".join(figures["reactions"]) or "-",
    ]


def _median_max(values: Report | None) -> tuple[str, str]:
    return ("-", "-") if values is None else (f"{values['median']:.4g}", f"{values['max']:.4g}")


def _faultless(parts: list[Report]) -> Iterator[str]:
    if not parts:
        return
    yield from ("", "## Faultless, in real time", "")
    rows = [
        [
            f"under {part['load']}" if part["load"] else "alone",
            f"{part['seconds']:.0f}",
            str(part["trips"]),
            _rate(part["trips_per_hour"]),
            ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in part["misses"].items())
            or "none",
        ]
        for part in parts
    ]
    yield from markdown_table(["", "s", "false trips", "an hour", "misses (no trips)"], rows)


def _sizes(sizes: Report) -> Iterator[str]:
    for kind, found in sizes.items():
        size = KINDS[kind].size
        unit = size.unit if size is not None else ""
        yield from ("", f"## {kind}: size against delay", "")
        yield from (f"Must be found from {found['judged_from']:g} {unit}.", "")
        points = [
            (f"{point['size']:.4g}", point["joint"] or "all", point["delay_ms"])
            for point in found["curve"]
        ]
        rows = [
            [size, joint, "-" if after_ms is None else f"{after_ms:g}"]
            for size, joint, after_ms in points
        ]
        yield from markdown_table([f"size, {unit}", "joint", "found after, ms"], rows)
