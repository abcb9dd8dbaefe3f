"""Analysis of a run, as data (analysis.json) and as text with tables."""

from __future__ import annotations

from collections.abc import Iterator

from rack.boards.timing.level import LevelTiming
from rack.boards.timing.trace_times import (
    compute_distribution,
    compute_overhead_ns,
    count_misses_and_skips,
)
from rack.boards.timing.verdicts import EquationVerdict, evaluate_rack
from rack.tools.console.answer import Document
from rack.tools.console.tables import Blocks
from rack.tools.recording.cycles import START_UP_S, Cycles, list_restarts
from rack.tools.recording.history import summarize_gaps
from rack.tools.report.analysis import (
    MOST_CYCLES_PERCENTILE,
    Analysis,
    EquationPair,
    compute_due_ns,
)
from rack.tools.report.task_times import MS_PER_NS, build_times_table, compute_task_times
from rack.tools.timing.summary import find_tightest, format_margin
from rack.tools.timing.tables import build_level_table, build_verdict_table

MAX_SHOWN_FAILURES = 8
"""Largest number of failed equations in the summary, worst first. --verbose shows all."""
_Side = LevelTiming | EquationVerdict | None


def build_document(analysis: Analysis) -> Document:
    """Return an analysis as plain data, the content of analysis.json.

    Infinite numbers become null. Restarts and the system response are in report.json only.
    """
    recording = analysis.recording
    config = recording.rack_config
    return {
        "rack": config.name,
        "folder": str(recording.folder),
        "mode": config.clock.mode,
        "speed": config.clock.speed,
        "clock_ms": config.clock.period_ms,
        "context_switch_ms": config.timing.context_switch_ms,
        "percentile": analysis.percentile,
        "start_up_s": START_UP_S,
        **summarize_gaps(recording),
        "holds": analysis.is_fulfilled,
        "levels": {
            name: _build_sides(
                analysis.predicted.levels.get(name), analysis.measured.levels.get(name)
            )
            for name in config.board
        },
        "tasks": {
            name: build_task_document(cycles, analysis) for name, cycles in analysis.cycles.items()
        },
        "core_loads": {f"core {core}": load for core, load in analysis.loads.items()},
        "equations": [
            {
                "equation": pair.equation,
                "subject": pair.subject,
                **_build_sides(pair.predicted, pair.measured),
                "disagrees": pair.is_contradicted,
            }
            for pair in analysis.pairs
        ],
        "mostly": {
            "percentile": MOST_CYCLES_PERCENTILE,
            "failed": [
                {"equation": p.equation, "subject": p.subject}
                for p in analysis.typical_pairs
                if p.is_failed
            ],
        },
    }


def _build_sides(predicted: _Side, measured: _Side) -> Document:
    """Return a predicted and a measured timing or verdict as plain data. None remains None."""
    sides = {"predicted": predicted, "measured": measured}
    return {
        side: None if side_timing is None else side_timing.to_document()
        for side, side_timing in sides.items()
    }


def build_task_document(cycles: Cycles, analysis: Analysis) -> Document:
    """Return counts and times in ms of a task's cycles, without start-up and stalled cycles.

    The result includes the entries of `compute_task_times`, in which execution and communication
    are processor times.
    """
    rack = analysis.predicted
    judged = cycles.is_judged
    rows = cycles.rows[judged]
    missed, skipped = count_misses_and_skips(rows)
    return {
        "role": cycles.task.role,
        "core": cycles.core,
        "priority": cycles.priority,
        "cycles": len(rows),
        "start_up": len(cycles.rows) - len(rows) - cycles.stalled_count,
        "stalled": cycles.stalled_count,
        "missed": missed,
        "skipped": skipped,
        "used_ms": compute_distribution(cycles.used_ns[judged] * MS_PER_NS),
        # Time per cycle outside the unit functions, for waking up and closing the cycle.
        "beside_ms": round(compute_overhead_ns(cycles.rows) * MS_PER_NS, 6),
        **compute_task_times(
            cycles.task,
            rows,
            rack.tick_ns,
            analysis.takes_time,
            stretches=analysis.recording.find_stretches(rows["tick"]),
            due_ns=compute_due_ns(rack, cycles.task),
            parts_ns=(cycles.process_ns[judged], cycles.communication_ns[judged]),
        ),
    }


def format_analysis(analysis: Analysis, is_verbose: bool) -> Blocks:
    """Yield an analysis as text: how the run ended, which equations held, and advice.

    Args:
        analysis: The analysis.
        is_verbose: Whether to append tables of all levels, tasks and equations.
    """
    yield from _format_summary(analysis)
    if not is_verbose:
        yield "--verbose shows every level, task and equation"
        return
    yield ""
    percentile = analysis.percentile
    which = "the worst cycle" if percentile >= 100 else f"{percentile:g} of 100 cycles"
    yield f"Levels: processor time in ms, in {which}; t_residual is alpha of eq. 3.6."
    sides = {"predicted": analysis.predicted.levels, "measured": analysis.measured.levels}
    names = analysis.recording.rack_config.board
    yield build_level_table(
        ((side, of[name]) for name in names for side, of in sides.items() if name in of), "side"
    )
    yield ""
    yield "Tasks, ms: exec and comm are processor time; R of a planner is its time slice."
    tasks = {
        name: build_task_document(cycles, analysis) for name, cycles in analysis.cycles.items()
    }
    yield build_times_table(tasks, analysis.takes_time)
    yield from ("", "Equations: in ms, predicted from the budgets, and measured.")
    yield build_verdict_table(
        (side, verdict)
        for pair in analysis.pairs
        for side, verdict in (("predicted", pair.predicted), ("measured", pair.measured))
        if verdict is not None
    )


def _format_summary(analysis: Analysis) -> Iterator[str]:
    """Yield the summary: how the run ended, failed equations, advice, and what was excluded."""
    verdicts = [pair.measured for pair in analysis.pairs if pair.measured is not None]
    failed = [verdict for verdict in verdicts if not verdict.holds]
    failed.sort(key=lambda verdict: verdict.margin / abs(verdict.right or 1.0))
    count = f"{len(verdicts)} equations"
    result = f"{len(failed)} of {count} failed" if failed else f"all {count} held"
    name = analysis.recording.rack_config.name
    ended = analysis.recording.end_counts
    cause = ended.get("outcome", {}).get("cause", "no end recorded")
    missed, skipped = (
        sum(count[kind] for count in ended.get("tasks", {}).values())
        for kind in ("missed", "skipped")
    )
    yield f"{name}: {result}; {cause}, {missed} cycles missed, {skipped} skipped"
    yield from (f"  {format_margin(verdict)}" for verdict in failed[:MAX_SHOWN_FAILURES])
    if failed and analysis.percentile > MOST_CYCLES_PERCENTILE:
        mostly = [pair for pair in analysis.typical_pairs if pair.is_failed]
        yield f"failed in more than 1 of 100 cycles: {_join_equations(mostly) or 'none'}"
    elif not failed:
        yield from find_tightest(verdicts)
    if differing := [pair for pair in analysis.pairs if pair.is_contradicted]:
        yield f"not as predicted: {_join_equations(differing)}"
    yield _choose_advice(analysis, bool(failed))
    if not analysis.predicted.levels:
        yield "no prediction: the config has no budgets (board.<name>.budget)"
    if analysis.predicted.is_lockstep:
        has_none = "simulated cores" if analysis.takes_time else "no deadlines, no lateness"
        yield f"lockstep: {has_none}; processor times are real"
    if restarted := list_restarts(analysis.recording):
        yield "restarts: " + ", ".join(f"{task} {len(ticks)}" for task, ticks in restarted.items())
    yield from _list_unjudged(analysis)


def _list_unjudged(analysis: Analysis) -> Iterator[str]:
    """Yield sentences about levels, cycles and rows that the verdicts do not cover."""
    config = analysis.recording.rack_config
    measured = analysis.measured.levels
    if unused := ", ".join(name for name in config.board if name not in measured):
        yield f"never ran: {unused}"
    if without_plan := ", ".join(
        level.board
        for level in measured.values()
        if level.planning_ns is None and level.coupling != "none"
    ):
        yield f"made no plan: {without_plan}"
    yield (
        f"the first {START_UP_S:g} s of each process are not judged; t_cs is"
        f" {config.timing.context_switch_ms:g} ms"
    )
    if stalled := ", ".join(
        f"{name} {cycles.stalled_count}"
        for name, cycles in analysis.cycles.items()
        if cycles.stalled_count
    ):
        yield f"stalled cycles are not judged: {stalled}"
    lost = [*map(str, analysis.recording.find_gaps())]
    for name, (traced, ran) in analysis.recording.count_traced_cycles().items():
        lost.append(f"{name} is judged by {traced:,} of {ran:,} cycles")
    if lost:
        yield "; ".join(lost)
    if kept := analysis.recording.kept_text:
        yield kept


def _choose_advice(analysis: Analysis, has_failed: bool) -> str:
    """Return a line that says what to do about failed equations, or about a failed run."""
    folder = analysis.recording.folder
    if not has_failed:
        outcome = analysis.recording.end_counts.get("outcome", {"cause": "time over"})
        if outcome.get("faults") or outcome["cause"] not in ("task done", "time over"):
            return f"to do: rack report {folder} says why the run failed; its timing held"
        return "to do: nothing"
    if any(pair.is_failed for pair in analysis.typical_pairs):
        if all(verdict.holds for verdict in evaluate_rack(analysis.measured)):
            return "to do: nothing about the config: its levels' own times fit; see --verbose"
        return (
            f"to do: rack check CONFIG --from {folder} lists changes that make it fit, if there are"
            " any"
        )
    return (
        "to do: nothing about the config: it failed in single cycles; --percentile 99 leaves them"
        " out"
    )


def _join_equations(pairs: list[EquationPair]) -> str:
    """Return equations with their subjects, as in "servo 3.1, servo 3.6, core 1 load"."""
    return ", ".join(f"{pair.subject} {pair.equation}" for pair in pairs)
