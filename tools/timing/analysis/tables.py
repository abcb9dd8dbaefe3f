"""An analysis as text: tables of levels, tasks and equations, and the cycles that broke one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from rack.levels.timing.level import LevelTiming
from rack.levels.timing.verdicts import EquationVerdict, verdicts
from rack.tools.console.tables import decimal, figure, fitted, ms
from rack.tools.recording.cycles import START_UP_S, Cycles, restarts
from rack.tools.timing.analysis.analysis import MOSTLY, Analysis, Pair
from rack.tools.timing.analysis.breaches import Breach, Broken
from rack.tools.timing.analysis.document import summary, task_document, worst_words
from rack.tools.timing.summary import tightest

SHOWN = 10
"""Most cycles in the list of those that broke an equation; the document has them all."""
LEVELS = ["level", "", "R_i", "t_exec", "C", "R", "W", "t_comm", "t_residual", "t_plan", "d"]
BY_THE_CLOCK = [
    "late p50",
    "late p99",
    "late p99.9",
    "late max",
    "response p99",
    "response max",
    "of",
    "largest gap",
]
TASKS = ["task", "cycles", "missed", "skipped", "deviation", "overhead", *BY_THE_CLOCK]
TASKS_DROPPED = (
    "late p99.9",
    "overhead",
    "late p50",
    "deviation",
    "largest gap",
    "cycles",
    "response p99",
    "late p99",
)
"""Columns that a narrow terminal leaves out, the first of them first."""
EQUATIONS = ["eq.", "of", "predicted", "holds", "measured", "margin", "held", "", "meaning"]
EQUATIONS_DROPPED = ("meaning", "margin", "predicted", "holds")


def text(analysis: Analysis) -> str:
    """Return everything as text for a screen or two."""
    return "\n".join(_lines(analysis))


def brief(analysis: Analysis) -> str:
    """Return what matters most: how the run ended, what held, and what to do."""
    return "\n".join([*_head(analysis), "--verbose shows every level, task and equation"])


def _lines(analysis: Analysis) -> Iterator[str]:
    yield from _head(analysis)
    yield ""
    yield (
        f"Levels: processor time in ms, {worst_words(analysis.percentile)}; t_residual is alpha of"
        " eq. 3.6."
    )
    sides = {"predicted": analysis.predicted.levels, "measured": analysis.measured.levels}
    levels = [
        _level_row(n, side, of[n])
        for n in analysis.config.board
        for side, of in sides.items()
        if n in of
    ]
    yield from fitted(LEVELS, levels, ("C", "R", "W", "d"))
    yield ""
    yield from (f"{name}: {summary(analysis, name)}" for name in analysis.config.board)
    yield ""
    yield (
        "Tasks: wall clock in ms. Deviation: standard deviation of the residual from cycle to"
        " cycle. Overhead: processor time of a cycle outside its parts, for waking up and closing"
        " it; the equations use 2 t_cs for it."
    )
    rows = [_task_row(name, cycles, analysis) for name, cycles in analysis.cycles.items()]
    # In lockstep there is no lateness and no deadline.
    shown = len(TASKS) - len(BY_THE_CLOCK) if analysis.predicted.is_lockstep else len(TASKS)
    yield from fitted(TASKS[:shown], [row[:shown] for row in rows], TASKS_DROPPED)
    yield from ("", "Equations: in ms, predicted from the budgets, and measured.")
    yield from fitted(EQUATIONS, list(map(_pair_row, analysis.pairs)), EQUATIONS_DROPPED)
    yield from _broken_cycles(analysis)


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
    yield (
        f"the first {START_UP_S:g} s of each process are not judged; t_cs is"
        f" {config.timing.context_switch_ms:g} ms"
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
        " out, --verbose says what had their core"
    )


def _named(pairs: list[Pair]) -> str:
    """Return equations by subject: "servo 3.1, 3.6; core 1 load"."""
    subjects = dict.fromkeys(pair.subject for pair in pairs)
    named = {
        name: ", ".join(pair.equation for pair in pairs if pair.subject == name)
        for name in subjects
    }
    return "; ".join(f"{name} {equations}" for name, equations in named.items())


def _level_row(name: str, side: str, timing: LevelTiming) -> list[str]:
    parts = (
        timing.execution_ns,
        timing.exchange_ns,
        timing.read_ns,
        timing.write_ns,
        timing.communication_ns,
    )
    times = [decimal(ns * 1e-6) for ns in (*parts, timing.residual_ns)]
    plan = "-" if timing.planning_ns is None else decimal(timing.planning_ns * 1e-6)
    d = "-" if timing.within_cycles is None else str(timing.within_cycles)
    return [name, side, f"{timing.cycle_ns * 1e-6:g}", *times, plan, d]


def _task_row(name: str, cycles: Cycles, analysis: Analysis) -> list[str]:
    found = task_document(cycles, analysis.predicted)
    late = found["lateness_ms"]
    response = found["response_ms"]
    gap = found["largest_gap_ms"]
    return [
        name,
        *(str(found[key]) for key in ("cycles", "missed", "skipped")),
        *(decimal(found[key]) for key in ("deviation_ms", "beside_ms")),
        *(figure(late, key) for key in ("p50", "p99", "p99_9", "max")),
        *(figure(response, key) for key in ("p99", "max")),
        f"{found['slice_ms']:g}",
        decimal(gap),
    ]


def _pair_row(pair: Pair) -> list[str]:
    predicted = pair.predicted
    measured = pair.measured
    verdict = measured or predicted
    meaning = "" if verdict is None else verdict.meaning
    differs = "not as predicted" if pair.disagrees else ""
    margin = "-" if measured is None else _number(measured.margin, measured.unit)
    sides, result = _sides(measured)
    return [
        pair.equation,
        pair.subject,
        *_sides(predicted),
        sides,
        margin,
        result,
        differs,
        meaning,
    ]


def _sides(verdict: EquationVerdict | None) -> tuple[str, str]:
    if verdict is None:
        return "-", ""
    result = "ok" if verdict.holds else "FAILS"
    return _relation(verdict), result


def _relation(relation: EquationVerdict | Broken) -> str:
    return (
        f"{_number(relation.left, relation.unit)} {relation.sign}"
        f" {_number(relation.right, relation.unit)}"
    )


def _broken_cycles(analysis: Analysis) -> Iterator[str]:
    judged = analysis.judged_breaches
    tick_s = analysis.recording.layout.clock_ns * 1e-9
    others = len(analysis.breaches) - len(judged)
    yield ""
    if not judged:
        yield (
            f"No cycle broke an equation by its own numbers, except {others} in start-ups and"
            " stalls."
        )
        return
    yield "Cycles that broke an equation by their own numbers:"
    for task in dict.fromkeys(breach.task for breach in judged):
        yield f"  {_counted(task, judged, int(analysis.cycles[task].is_judged.sum()))}"
    yield f"  in start-ups and stalls: {others}"
    shown = judged[:SHOWN]
    yield ""
    yield f"The worst {len(shown)}, with the use of their core:"
    for breach in shown:
        broken = "; ".join(f"{each.equation} {_relation(each)}" for each in breach.broken)
        yield f"  {breach.task} at tick {breach.tick}, {breach.tick * tick_s:.3f} s: {broken}"
        yield f"    {breach.sharing.text()}"
    if len(judged) > SHOWN:
        yield f"  and {len(judged) - SHOWN} more: --json has them all"


def _counted(task: str, judged: tuple[Breach, ...], of_all: int) -> str:
    mine = [breach for breach in judged if breach.task == task]
    counts = Counter(broken.equation for breach in mine for broken in breach.broken)
    by_equation = ", ".join(f"{equation} {count}" for equation, count in counts.items())
    return f"{task}: {len(mine)} of {of_all} ({100 * len(mine) / of_all:.3g} %): {by_equation}"


def _number(value: float, unit: str) -> str:
    return decimal(value) if unit == "1" else ms(value)
