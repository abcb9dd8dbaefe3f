"""An analysis as text: tables of levels, tasks and equations."""

from __future__ import annotations

from collections.abc import Iterator

from rack.levels.timing.verdicts import verdicts
from rack.tools.console.tables import Blocks
from rack.tools.recording.cycles import START_UP_S, restarts
from rack.tools.timing.analysis.analysis import MOSTLY, Analysis, Pair
from rack.tools.timing.analysis.document import task_document
from rack.tools.timing.analysis.task_times import times_table
from rack.tools.timing.summary import tightest
from rack.tools.timing.tables import level_table, verdict_table


def analysis_blocks(analysis: Analysis, is_verbose: bool) -> Blocks:
    """Yield an analysis as text: how the run ended, what held, and what to do; if verbose, every
    level, task and equation."""
    yield from _head(analysis)
    if not is_verbose:
        yield "--verbose shows every level, task and equation"
        return
    yield ""
    yield (
        f"Levels: processor time in ms, {_worst_words(analysis.percentile)}; t_residual is alpha of"
        " eq. 3.6."
    )
    sides = {"predicted": analysis.predicted.levels, "measured": analysis.measured.levels}
    names = analysis.config.board
    yield level_table(
        ((side, of[name]) for name in names for side, of in sides.items() if name in of), "side"
    )
    yield ""
    yield "Tasks, ms: exec and comm are processor time; R of a planner is its time slice."
    tasks = {
        name: task_document(cycles, analysis.predicted) for name, cycles in analysis.cycles.items()
    }
    yield times_table(tasks, analysis.predicted.is_lockstep)
    yield from ("", "Equations: in ms, predicted from the budgets, and measured.")
    yield verdict_table(
        (side, verdict)
        for pair in analysis.pairs
        for side, verdict in (("predicted", pair.predicted), ("measured", pair.measured))
        if verdict is not None
    )


def _worst_words(percentile: float) -> str:
    return "in the worst cycle" if percentile >= 100 else f"in {percentile:g} of 100 cycles"


def _head(analysis: Analysis) -> Iterator[str]:
    config = analysis.config
    pairs = [pair for pair in analysis.pairs if pair.measured is not None]
    failing = [pair for pair in pairs if pair.fails]
    yield f"{config.name}: {_ended(analysis)}"
    if not failing:
        yield f"all {len(pairs)} equations held"
    else:
        yield f"{len(pairs) - len(failing)} of {len(pairs)} equations held"
        yield f"failed: {_named(failing)}"
        if analysis.percentile > MOSTLY:
            mostly = [pair for pair in analysis.mostly if pair.fails]
            yield f"failed in more than 1 of 100 cycles: {_named(mostly) or 'none'}"
    if differing := [pair for pair in pairs if pair.disagrees]:
        yield f"not as predicted: {_named(differing)}"
    yield from tightest([pair.measured for pair in pairs if pair.measured is not None])
    yield _advice(analysis, failing)
    if not analysis.predicted.levels:
        yield "no prediction: the config has no budgets (board.<name>.budget)"
    if analysis.predicted.is_lockstep:
        yield "lockstep: no deadlines, no lateness; processor times are real"
    if restarted := restarts(analysis.recording):
        yield "restarts: " + ", ".join(f"{task} {len(ticks)}" for task, ticks in restarted.items())
    yield from _left_out(analysis)


def _left_out(analysis: Analysis) -> Iterator[str]:
    """Yield whatever was not judged."""
    measured = analysis.measured.levels
    if silent := ", ".join(name for name in analysis.config.board if name not in measured):
        yield f"never ran: {silent}"
    if planless := ", ".join(
        level.board
        for level in measured.values()
        if level.planning_ns is None and level.coupling != "none"
    ):
        yield f"made no plan: {planless}"
    yield (
        f"the first {START_UP_S:g} s of each process are not judged; t_cs is"
        f" {analysis.config.timing.context_switch_ms:g} ms"
    )
    if stalled := ", ".join(
        f"{name} {cycles.stalled}" for name, cycles in analysis.cycles.items() if cycles.stalled
    ):
        yield f"cycles with a stall in them are not judged: {stalled}"
    for name, (traced, ran) in analysis.recording.untraced().items():
        yield f"{name}: judged by {traced:,} of {ran:,} cycles"
    yield from (
        f"{count} rows of {name} were lost"
        for name, count in analysis.recording.lost.items()
        if count
    )
    yield from map(str, analysis.recording.gaps())
    if kept := analysis.recording.kept_text:
        yield kept


def _ended(analysis: Analysis) -> str:
    """Return how the run ended, and the cycles that it missed."""
    ended = analysis.recording.ended
    cause = ended.get("outcome", {}).get("cause", "no end recorded")
    counts = ended.get("tasks", {}).values()
    missed = sum(count["missed"] for count in counts)
    skipped = sum(count["skipped"] for count in counts)
    if not missed + skipped:
        return f"{cause}, no cycle missed or skipped"
    return f"{cause}, {missed} cycles missed, {skipped} skipped"


def _advice(analysis: Analysis, failing: list[Pair]) -> str:
    """Return what to do about equations that failed, or about a run that failed without them."""
    folder = analysis.recording.folder
    if not failing:
        outcome = analysis.recording.ended.get("outcome", {"cause": "time over"})
        if outcome.get("faults") or outcome["cause"] not in ("task done", "time over"):
            return f"to do: rack report {folder} says why the run failed; its timing held"
        return "to do: nothing"
    if any(pair.fails for pair in analysis.mostly):
        if all(verdict.holds for verdict in verdicts(analysis.measured)):
            return "to do: nothing about the config: its levels' own times fit; see --verbose"
        return (
            f"to do: rack check CONFIG --from {folder} lists changes that make it fit, if there are"
            " any"
        )
    return (
        "to do: nothing about the config: it failed in single cycles; --percentile 99 leaves them"
        " out"
    )


def _named(pairs: list[Pair]) -> str:
    """Return equations by subject: "servo 3.1, 3.6; core 1 load"."""
    subjects = dict.fromkeys(pair.subject for pair in pairs)
    named = {
        name: ", ".join(pair.equation for pair in pairs if pair.subject == name)
        for name in subjects
    }
    return "; ".join(f"{name} {equations}" for name, equations in named.items())
