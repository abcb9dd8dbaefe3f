"""Report of a campaign: campaign.json, and campaign.md with the same figures as readable text."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, get_args

from rack.boards.faults.kind import KINDS
from rack.tools.console.answer import Document
from rack.tools.console.tables import format_markdown_table
from rack.tools.faults.campaigns.campaign import Campaign
from rack.tools.faults.campaigns.results import Ended, Results, TrialResult
from rack.tools.faults.campaigns.statistics import (
    EventRate,
    FaultCounts,
    KindFigures,
    SizeCurve,
    Spread,
    compute_by_kind,
    compute_rate,
    count_faults,
    list_size_points,
)
from rack.tools.faults.judge import Judgement

MAX_SHOWN = 30
"""Maximum number of shortfalls in campaign.md. campaign.json contains all of them."""
KINDS_HEAD = [
    "kind",
    "injected",
    "detected",
    "in bound",
    "recovered",
    "at least",
    "ticks median",
    "max",
    "bound, ticks",
    "ms median",
    "max",
    "recovery median, ms",
    "max",
    "reactions",
]


@dataclass(frozen=True)
class CampaignSummary(FaultCounts):
    """Figures of all kinds together.

    Attributes:
        trials: Number of trials.
        tasks_done: Trials whose task was done.
        verdicts_certain: Trials that were ended once the verdict on each fault was certain.
        safely_stopped: Trials that ended with the arm at rest and no limit violated.
        not_armed: Trials whose launch was refused because of a fault.
        neither: All other trials.
        limits_violated: Number of violated limits, checked at every substep.
        touches: Number of unintended contacts.
        left_behind: Number of processes and segments that were left behind.
        simulated_s: Simulated time of all runs in s.
        unexplained: Detections that no fault explains.
        unexplained_per_hour: Their rate in simulated time.
        stray_misses: Deadline misses that no fault explains, in real time.
        false_trips: Unexplained detections in faultless time.
        faultless_s: Simulated time without faults in s.
        false_trips_per_hour: Rate of false trips.
    """

    trials: int
    tasks_done: int
    verdicts_certain: int
    safely_stopped: int
    not_armed: int
    neither: int
    limits_violated: int
    touches: int
    left_behind: int
    simulated_s: float
    unexplained: int
    unexplained_per_hour: EventRate | None
    stray_misses: int
    false_trips: int
    faultless_s: float
    false_trips_per_hour: EventRate | None


class CampaignReport:
    """Figures of a campaign.

    Attributes:
        order: Specification of the campaign.
        results: Results of all runs.
        clock_ms: Length of a tick in ms.
        summary: Figures of all kinds together.
        by_kind: Figures of each kind.
        curves: Curve of size against delay, by kind.
        shortfalls: Reasons why the campaign fails. Empty if it passes.
        modes: Clock modes, as text.
    """

    def __init__(self, campaign: Campaign, results: Results, wall_s: float) -> None:
        clock_ns = campaign.layout.clock_ns
        swept = [fault for run in results.sizes for fault in run.faults] + results.faults
        curves = {
            kind.name: SizeCurve(kind.visible_from, list_size_points(swept, kind.name, clock_ns))
            for kind in KINDS
            if kind.visible_from is not None
        }
        self.order = campaign.order
        self.results = results
        self.clock_ms = clock_ns * 1e-6
        self.summary = _build_summary(results, 1e9 / clock_ns)
        self.by_kind = compute_by_kind(results.faults, clock_ns)
        self.curves = {kind: curve for kind, curve in curves.items() if curve.curve}
        self.shortfalls = _list_shortfalls(results)
        self.modes = ["lockstep" if mode else "realtime" for mode in campaign.order.modes]
        self._kinds = campaign.kinds
        self._wall_s = round(wall_s, 1)

    @property
    def trials_text(self) -> str:
        """Text with the number of trials and their clock modes."""
        return f"{self.summary.trials} trials, {' and '.join(self.modes)}"

    def list_faults(self, kind: str) -> list[Judgement]:
        """Return the judgements of all faults of a kind."""
        return [fault for fault in self.results.faults if fault.kind == kind]

    def to_document(self) -> Document:
        """Return the content of campaign.json."""
        run = self.results.nominal
        return {
            "config": self.order.name,
            "seed": self.order.seed,
            "modes": self.modes,
            "kinds": self._kinds,
            "interrupted": self.results.is_interrupted,
            "wall_s": self._wall_s,
            "machine": {
                "cores": len(os.sched_getaffinity(0)),
                "kernel": platform.release(),
                "python": platform.python_version(),
                "notes": self._list_notes(),
            },
            "clock_ms": self.clock_ms,
            "nominal": {
                "ticks": run.ticks,
                "seconds": round(run.ticks * self.clock_ms * 1e-3, 3),
                "digest": run.digest,
            },
            "summary": asdict(self.summary),
            "by_kind": {
                kind: {**asdict(figures), **self._count_trials(kind)}
                for kind, figures in self.by_kind.items()
            },
            "sizes": {kind: asdict(size_curve) for kind, size_curve in self.curves.items()},
            "faultless": [stretch.to_document() for stretch in self.results.faultless],
            "faults": [
                {"trial": run.plan.number, "lockstep": run.plan.lockstep, **asdict(fault)}
                for run in self.results.trials
                for fault in run.faults
            ],
            "trials": [_to_trial_entry(run) for run in self.results.trials],
            "shortfalls": self.shortfalls,
        }

    def _list_notes(self) -> list[str]:
        """Return the distinct messages of all real-time launches."""
        # Omit lockstep, where each launch has the message that all boards share one core.
        runs = [run for run in self.results.runs if not run.plan.lockstep]
        return list(dict.fromkeys(note for run in runs for note in run.notes))

    def _count_trials(self, kind: str) -> dict[str, int]:
        """Count the trials in which a kind acted, and those among them whose task was done."""
        ends = [
            run.ended
            for run in self.results.trials
            if any(fault.kind == kind and fault.struck >= 0 for fault in run.faults)
        ]
        return {"trials": len(ends), "tasks_done": ends.count("task done")}

    def to_markdown(self) -> str:
        """Return the content of campaign.md."""
        return "\n".join(self._format_lines()) + "\n"

    def _format_lines(self) -> Iterator[str]:
        """Yield the lines of campaign.md."""
        verdict = "fell short" if self.shortfalls else "passed"
        cores = len(os.sched_getaffinity(0))
        interrupted = " The campaign was interrupted." if self.results.is_interrupted else ""
        yield f"# Campaign on {self.order.name}, seed {self.order.seed}: {verdict}"
        yield ""
        yield (
            f"{self.trials_text}, in {self._wall_s:.0f} s on {cores} cores, Linux"
            f" {platform.release()}.{interrupted}"
        )
        yield from (f"- {note}" for note in self._list_notes())
        yield ""
        yield from format_markdown_table(
            ["", ""], [[name, str(value)] for name, value in self._format_summary()]
        )
        if self.by_kind:
            yield from ("", "## Faults by kind", "")
            rows = [_format_kind(kind, figures) for kind, figures in self.by_kind.items()]
            yield from format_markdown_table(KINDS_HEAD, rows)
            yield ""
            yield (
                "'At least' is the smallest lower bound of Wilson's 95 % intervals for the shares"
                " detected, in bound and recovered."
            )
        yield from self._format_faultless()
        for kind, size_curve in self.curves.items():
            yield from _format_sizes(kind, size_curve)
        if self.shortfalls:
            yield from ("", f"## Shortfalls: {len(self.shortfalls)}", "")
            yield from (f"- {line}" for line in self.shortfalls[:MAX_SHOWN])

    def _format_summary(self) -> Iterator[tuple[str, Any]]:
        """Yield name and value of each row of the summary."""
        summary = self.summary
        redrawn = f"{summary.not_struck} more did not strike and were drawn again"
        yield "injected", f"{summary.injected}; {redrawn}"
        yield "detected", summary.detected
        yield "within the bound", summary.within_bound
        yield "reacted to", summary.reacted_to
        recovered = str(summary.recovered)
        if summary.latched:
            recovered += f", including {summary.latched} that ended the task, as permitted"
        yield "recovered from", recovered
        end_counts = self.results.ended
        ends = [f"{end_counts[name]} {name}" for name in get_args(Ended) if end_counts[name]]
        yield "trials ended", ", ".join(ends) or "none"
        continued = [run for run in self.results.trials if run.start]
        skipped_s = sum(run.start for run in continued) * self.clock_ms * 1e-3
        saved = f"{len(continued)} trials, {skipped_s:.0f} simulated s of the faultless run"
        yield "continued from a snapshot", saved
        yield "limits violated", f"{summary.limits_violated} (in any substep of any run)"
        yield "touches", summary.touches
        yield "left behind", f"{summary.left_behind} (processes, segments)"
        unexplained = f"{summary.unexplained} in {summary.simulated_s / 3600.0:.2f} simulated hours"
        yield "false detections", f"{unexplained}: {_format_rate(summary.unexplained_per_hour)}"
        if summary.faultless_s:
            trips = f"{summary.false_trips} in {summary.faultless_s:g} s"
            trips_per_hour = _format_rate(summary.false_trips_per_hour)
            yield "of these without faults, in real time", f"{trips}: {trips_per_hour}"
        yield "unexplained misses in real time", summary.stray_misses

    def _format_faultless(self) -> Iterator[str]:
        """Yield the lines of the section about faultless time."""
        rows = []
        for stretch in self.results.faultless:
            load = f"under {stretch.load}" if stretch.load else "alone"
            misses = [f"{count} {name.replace('_', ' ')}" for name, count in stretch.misses.items()]
            row = [load, f"{stretch.seconds:.0f}", str(stretch.trips), _format_rate(stretch.rate)]
            rows.append([*row, ", ".join(misses) or "none"])
        if rows:
            yield from ("", "## Faultless, in real time", "")
            head = ["", "s", "false trips", "an hour", "misses (no trips)"]
            yield from format_markdown_table(head, rows)


def _build_summary(results: Results, second: float) -> CampaignSummary:
    """Compute the figures of all kinds together. `second` is the number of ticks in a second."""
    trials = results.trials
    runs = results.runs
    end_counts = results.ended
    faultless_s = sum(stretch.seconds for stretch in results.faultless)
    trips = sum(stretch.trips for stretch in results.faultless)
    simulated_s = sum(run.ticks for run in runs) / second
    unexplained = sum(len(run.unexplained) for run in runs)
    return CampaignSummary(
        **vars(count_faults(results.faults)),
        trials=len(trials),
        tasks_done=end_counts["task done"],
        verdicts_certain=end_counts["verdicts certain"],
        safely_stopped=end_counts["safely stopped"],
        not_armed=end_counts["not armed"],
        neither=end_counts["neither"],
        limits_violated=sum(run.violations for run in runs),
        touches=sum(run.touches for run in runs),
        left_behind=sum(len(run.left) for run in runs),
        simulated_s=round(simulated_s, 1),
        unexplained=unexplained,
        unexplained_per_hour=compute_rate(unexplained, simulated_s),
        stray_misses=sum(run.stray_misses for run in trials if not run.plan.lockstep),
        false_trips=trips,
        faultless_s=round(faultless_s, 1),
        false_trips_per_hour=compute_rate(trips, faultless_s),
    )


def _list_shortfalls(results: Results) -> list[str]:
    """Return the shortfalls of all runs, and kinds that acted too rarely."""
    lines = [f"{run.plan.name}: {line}" for run in results.runs for line in run.shortfalls]
    return lines + results.lacking


def _to_trial_entry(run: TrialResult) -> Document:
    """Return the entry of a trial in campaign.json."""
    return {
        "number": run.plan.number,
        "purpose": run.plan.purpose,
        "lockstep": run.plan.lockstep,
        "faults": len(run.faults),
        "ended": run.ended,
        "from_tick": run.start,
        "whole": run.whole,
        "wall_s": round(run.wall_s, 1),
        "shortfalls": list(run.shortfalls),
    }


def _format_rate(event_rate: EventRate | None) -> str:
    """Format a rate with its confidence bound. None becomes "-"."""
    if event_rate is None:
        return "-"
    return f"{event_rate.an_hour:.3g} an hour, below {event_rate.below:.3g} with 95 % confidence"


def _format_kind(kind: str, figures: KindFigures) -> list[str]:
    """Return the cells of a kind's row in the table of kinds."""
    counts = (figures.injected, figures.detected, figures.within_bound, figures.recovered)
    lowest = [share[0] for share in figures.wilson.values() if share is not None]
    worst = f"{min(lowest):.1%}" if lowest else "-"
    bounds = (figures.bound_ticks or {}).values()
    return [
        kind,
        *map(str, counts),
        worst,
        *_format_spread(figures.ticks),
        "-".join(dict.fromkeys(map(str, bounds))) or "-",
        *_format_spread(figures.ms),
        *_format_spread(figures.recovery_ms),
        ", ".join(figures.reactions) or "-",
    ]


def _format_spread(values: Spread | None) -> tuple[str, str]:
    """Format median and maximum. Both are "-" for None."""
    return ("-", "-") if values is None else (f"{values.median:.4g}", f"{values.max:.4g}")


def _format_sizes(kind: str, curve_of_sizes: SizeCurve) -> Iterator[str]:
    """Yield the lines of the section about a kind's curve of size against delay."""
    size = KINDS[kind].size
    unit = size.unit if size is not None else ""
    yield from ("", f"## {kind}: size against delay", "")
    yield from (
        f"Errors must be detected from a size of {curve_of_sizes.judged_from:g} {unit}.",
        "",
    )
    rows = []
    for point in curve_of_sizes.curve:
        after_ms = "-" if point.delay_ms is None else f"{point.delay_ms:g}"
        rows.append([f"{point.size:.4g}", point.joint or "all", after_ms])
    yield from format_markdown_table([f"size, {unit}", "joint", "found after, ms"], rows)
