"""Summary of a report in at most 25 lines: the verdict, what happened, and what to do next.

`rack run` and `rack report` print it. Everything else is in the whole report.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from math import ceil
from shlex import quote
from textwrap import wrap

from rich.console import Console
from rich.text import Text

from rack.boards.events import Braking, format_brakings
from rack.tools.console.answer import Document
from rack.tools.console.tables import Cell, TextTable, format_decimal, render_text
from rack.tools.report import miss_causes
from rack.tools.report.arm_outcome import Row, list_outcome_rows
from rack.tools.report.report_markdown import (
    format_comparison,
    format_other_rack,
    format_peer,
    format_queue,
)
from rack.tools.report.run_report import RunReport

WIDTH = 80
"""Width of the summary. A narrower terminal gets more lines."""
MIN_WIDTH = 40
MAX_LINES = 25
MAX_PART_LINES = 5
"""Largest number of lines with reasons, and of lines with causes and responses."""
MAX_ROW_LINES = 2
MIN_TABLE_LINES = 5
INDENT = 10
"""Width of the labels."""
LONG_HOLD_S = 0.5
"""Shortest hold of a level's own that the summary mentions. It mentions all of an operator."""
DROPPED = ("proc p99", "late ms", "cycle ms", "used %")
"""Columns of the table of tasks that a narrow terminal leaves out, in this order."""
VERDICT_STYLES = {"DONE": "green", "TIME OVER": "green", "PARTLY JUDGED": "yellow"}


def show_summary(document: Document, console: Console) -> None:
    """Print the summary of a run, and its comparison with another run if there is one.

    On a terminal the verdict and the tasks that lost cycles are coloured.
    """
    report = RunReport.from_document(document)
    first, *lines = format_run_summary(document, max(MIN_WIDTH, min(WIDTH, console.width)))
    style = VERDICT_STYLES.get(_find_verdict(report), "red")
    console.print(Text(first, f"bold {style}"), soft_wrap=True)
    if report.against:
        lines[:0] = format_comparison(report.against)
    for line in lines:
        # Let the terminal wrap long commands, so that they can be copied.
        console.print(Text(line, "red" * line.startswith("!")), soft_wrap=True)


def format_run_summary(document: Document, width: int = WIDTH) -> list[str]:
    """Return the lines of the summary of a run.

    The verdict is the first line. Lines about tasks that lost cycles begin with "!". Only commands
    and folders may be longer than `width`.

    Args:
        document: A report.
        width: Number of columns, at most `WIDTH`.
    """
    report = RunReport.from_document(document)
    folds = ceil(WIDTH / width)
    lines = _format_headline(report, width)
    lines += [*_format_rows(_list_reasons(report), width, MAX_PART_LINES * folds), ""]
    rows = [*_list_causes(report), ("response", _list_responses(report))]
    end = ["", *_format_rows(rows, width, MAX_PART_LINES * folds), *_format_files(report, width)]
    room = MAX_LINES * folds - len(lines) - len(end)
    facts = _format_rows(_list_facts(report), width, room - MIN_TABLE_LINES - 1)
    lines += [*facts, ""] if facts else []
    return [*lines, *_format_tasks(report, width, MAX_LINES * folds - len(lines) - len(end)), *end]


def _format_rows(rows: Sequence[Row], width: int, max_lines: int) -> list[str]:
    """Format rows as aligned lines, and say how many lines do not fit."""
    lines = [
        line
        for label, clauses in rows
        if clauses
        for line in wrap(
            "; ".join(clauses),
            width,
            initial_indent=f"{label:{INDENT}}",
            subsequent_indent=" " * INDENT,
            break_on_hyphens=False,
            max_lines=MAX_ROW_LINES * ceil(WIDTH / width) + (label in ("because", "unjudged")),
            placeholder=" ... see --full",
        )
    ]
    hidden = len(lines) - max_lines
    return (
        [*lines[: max_lines - 1], f"{'':{INDENT}}{hidden + 1} more lines: see --full"]
        if hidden > 0
        else lines
    )


def _find_verdict(report: RunReport) -> str:
    """Return the verdict. It is never DONE if something was left out of it."""
    outcome = report.outcome or {"cause": "", "faults": ()}
    if report.failures:
        is_stopped = outcome["cause"] == "stopped" and not outcome["faults"]
        return "STOPPED" if is_stopped and len(report.failures) == 1 else "FAILED"
    left_out = report.unjudged or report.kept or report.rows_lost
    if left_out or report.recording != "complete":
        return "PARTLY JUDGED"
    return "DONE" if outcome["cause"] == "task done" else "TIME OVER"


def _format_headline(report: RunReport, width: int) -> list[str]:
    """Return the verdict with the simulated time, and the verdict on the timing."""
    verdict = _find_verdict(report)
    words = [f"{verdict}, {report.outcome['cause']}," if verdict == "PARTLY JUDGED" else verdict]
    words += ["in" if verdict == "DONE" else "after", f"{report.simulated_s:g} s"]
    speed = "" if report.speed == 1.0 else f" x {report.speed:g}"
    mode = "lockstep" if report.mode == "lockstep" else f"real time{speed}"
    left = f"{report.rack}: {' '.join(words)} ({mode})"
    right = "no deadlines in lockstep" if report.mode == "lockstep" else "no cycle missed"
    name, task = _sort_tasks(report)[0]
    if _count_losses(task):
        verb = "missed" if task["missed"] else "skipped"
        due = task.get("due") or task["traced"] + task["skipped"]
        right = f"{name} {verb} {task[verb]:,} of {due:,} cycles"
    right = f"timing: {right}"
    gap = width - len(left) - len(right)
    return [left + " " * gap + right] if gap > 1 else [*wrap(left, width), *wrap(right, width)]


def _sort_tasks(report: RunReport) -> list[tuple[str, Document]]:
    """Return the tasks: those that lost most cycles first, then those that use most."""
    tasks = report.tasks.items()
    return sorted(tasks, key=lambda item: (-_count_losses(item[1]), -_compute_use(item[1])))


def _count_losses(task: Document) -> int:
    """Return the number of missed and skipped cycles of a task."""
    return int(task.get("missed", 0) + task.get("skipped", 0))


def _compute_use(task: Document) -> float:
    """Return the percentage of its cycle or slice that a task uses: p99 of its processor time."""
    times = task.get("processor_ms")
    return 100.0 * times["p99"] / task["slice_ms"] if times else 0.0


def _list_reasons(report: RunReport) -> list[Row]:
    """Return why a run failed, and what its verdict does not cover."""
    rows = [("because", [why.removeprefix("stopped: ")]) for why in report.failures]
    rows += [("unjudged", [line]) for line in report.unjudged]
    if not any(report.recording in why for why in report.failures):
        lost = [
            f"{count:,} rows of {name} lost" for name, count in (report.rows_lost or {}).items()
        ]
        rows.append(
            (
                "recording",
                [report.recording] * (report.recording not in ("complete", "none")) + lost,
            )
        )
    return [*rows, ("recording", [report.kept] if report.kept else [])]


def _list_facts(report: RunReport) -> list[Row]:
    """Return what happened in a run, the most important subjects first."""
    outcome = report.outcome or {"reason": "", "brakings": ()}
    brakings = [Braking(**braking) for braking in outcome["brakings"]]
    braked = [format_brakings(brakings).removeprefix("brakes ")] if brakings else []
    # A failure or the task's status may contain the reason already.
    is_said = report.task or any(outcome["reason"] in why for why in report.failures)
    rows: list[Row] = [("result", [outcome["reason"]] if outcome["reason"] and not is_said else [])]
    rows += [*list_outcome_rows(report), ("brakes", braked)]
    rows.append(("faults", _list_fault_clauses(report)))
    holds = [
        hold
        for hold in report.holds or ()
        if hold["lasted_s"] >= LONG_HOLD_S or hold["by"] == "operator"
    ]
    if holds:
        longest = max(holds, key=lambda hold: hold["lasted_s"])
        span = f"{longest['level']} for {longest['lasted_s']:g} s from {longest['since_s']:g} s"
        rows.append(("holds", [f"{len(holds)}, longest {span}: {longest['why']}"]))
    restarts = [f"{task} {count}" for task, count in (report.restarts or {}).items()]
    rows += [("restarts", restarts), ("racks", [*map(format_other_rack, report.others)])]
    rows += [("peer", [format_peer(peer)]) for peer in (report.network or {"peers": ()})["peers"]]
    for level, fired in [*(report.state_tables or {}).items()][:1]:
        newest = f"newest '{fired[-1]['name']}' at {fired[-1]['first_s']:.2f} s"
        rows.append(("table", [f"{level} fired {len(fired)} rows, {newest}"]))
    if queues := report.queues:
        rows.append(("queue", [format_queue(max(queues, key=lambda queue: queue["refused"]))]))
    ages = [
        (entry["age_ms"]["max"], entry["entry"])
        for entry in report.entries or ()
        if entry["age_ms"]
    ]
    if ages:
        rows.append(("host", ["oldest message {:g} ms, {}".format(*max(ages))]))
    return [*rows, ("notes", report.notes or [])]


def _list_fault_clauses(report: RunReport) -> list[str]:
    """Return clauses about injected faults, and about detections without a fault."""
    if (faults := report.faults) is None:
        return []
    struck = [fault for fault in faults if fault["seen"] != "not struck"]
    bad = [f for f in struck if not (f["is_recovered"] and (f["is_within"] or not f["is_judged"]))]
    good = sum(fault["is_recovered"] and fault["is_within"] for fault in struck)
    clauses = []
    if faults:
        clauses += [f"{len(struck)} of {len(faults)} acted"]
        clauses += [f"{good} detected within bounds and recovered from"]
    if bad:
        first = f"{bad[0]['kind']} of {bad[0]['board']} at tick {bad[0]['struck']}"
        clauses.append(f"{len(bad)} not, first {first}")
    if found := report.unexplained:
        clauses.append(f"{len(found)} detections without a fault, first: {found[0]['text']}")
    return clauses or ["none"]


def _format_tasks(report: RunReport, width: int, max_lines: int) -> list[str]:
    """Return the table of tasks. Its last line is about the tasks that do not fit."""
    tasks = _sort_tasks(report)
    shown = tasks if len(tasks) < max_lines else tasks[: max_lines - 1 - ceil(WIDTH / width)]
    rows: list[dict[str, Cell]] = []
    for name, task in shown:
        times, late = task.get("processor_ms"), task.get("lateness_ms")
        row: dict[str, Cell] = {"": f"{'!' if _count_losses(task) else ' '} {name}"}
        row["cycle ms"] = task.get("slice_ms") or 1e3 / task["rate_hz"]
        if report.folder is not None:
            row["proc p99"] = format_decimal((times or {}).get("p99"), 2)
            row["used %"] = f"{_compute_use(task):.0f}" if times else None
        row |= {kind: task.get(kind) for kind in ("missed", "skipped")}
        if report.folder is not None and report.mode != "lockstep":
            row["late ms"] = format_decimal((late or {}).get("max"), 2)
        rows.append(row)
    lines = [*render_text([TextTable(rows, DROPPED)], width)]
    if others := [task for _, task in tasks[len(shown) :]]:
        lossy = sum(_count_losses(task) > 0 for task in others) or "none"
        most = f"at most {max(map(_compute_use, others)):.0f} % used"
        rest = f"{len(others)} more: {lossy} missed or skipped, {most}"
        lines += wrap(rest, width, initial_indent="  ", subsequent_indent="  ")
    return lines


def _list_causes(report: RunReport) -> list[Row]:
    """Return the causes of lost cycles, and whether the task that lost most fits its cycle."""
    causes: Counter[str] = Counter()
    longest_ms: dict[str, float] = {}
    for miss in report.misses or ():
        why = miss["why"]
        causes[why] += miss["count"]
        longest_ms[why] = max(longest_ms.get(why, 0.0), miss["why_ms"] or 0.0)
    # The recording may lack rows.
    causes[miss_causes.NOT_RECORDED] += max(0, report.missed + report.skipped - causes.total())
    clauses = [
        f"{count:,}: {why}" + (f", up to {ms:.2g} ms" if (ms := longest_ms.get(why)) else "")
        for why, count in causes.most_common()
        if count > 0
    ]
    name, task = _sort_tasks(report)[0]
    times, slice_ms = task.get("processor_ms"), task.get("slice_ms")
    judgement = []
    if clauses and times and report.mode != "lockstep":
        fits = times["p50"] <= slice_ms
        verb = "fits" if fits else "is too long"
        judgement = [f"{name} {verb} (median {times['p50']:.2g} of {slice_ms:g} ms)"]
        outside = causes[miss_causes.HYPERVISOR] + causes[miss_causes.CORE_TAKEN]
        if fits and 2 * outside > causes.total():
            judgement.append("the machine was late")
    return [("cause", clauses), ("", judgement)]


def _list_responses(report: RunReport) -> list[str]:
    """Return clauses about the system response in both directions, ms of simulated time."""
    clauses = []
    for direction in ("command", "status") if report.system_response else ():
        chain = report.system_response[direction]
        if (times := chain["measured_ms"]) is None:
            clauses.append(f"{direction} not measured")
            continue
        bound, beyond = chain["bound_ms"], chain["beyond"]
        verdict = f" (bound {bound:g})"
        if report.system_response["crosses_racks"]:
            verdict = " (no bound)"
        elif beyond:
            count = "once" if len(beyond) == 1 else f"{len(beyond)} times"
            slow = max(beyond, key=lambda slow: slow["ms"])
            verdict = f", {slow['ms'] - bound:g} over its bound {count}, after tick {slow['tick']}"
        clauses.append(f"{direction} {times['max']:g} ms{verdict}")
    return clauses


def _format_files(report: RunReport, width: int) -> list[str]:
    """Return the folder of a run, and the commands that show more of it."""
    if (run := report.folder) is None:
        return [f"{'files':{INDENT}}none, not recorded"] if report.recording == "none" else []
    name = quote(str(run))
    commands = [f"rack report {name} --full", f"rack replay {name}", f"rack analyze {name}"]
    separator = "    " if len("    ".join(commands)) <= width - INDENT else f"\n{'':{INDENT}}"
    size = f"{(report.bytes or 0) * 1e-6:.1f} MB"
    following = f"{'next':{INDENT}}{separator.join(commands)}"
    return [f"{'files':{INDENT}}{run} ({size})", *following.splitlines()]
