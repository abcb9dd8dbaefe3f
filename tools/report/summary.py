"""Summary of a report in at most 25 lines: the verdict, what happened, and what to do next.

`rack run` and `rack report` print it. Everything else is in the whole report.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from math import ceil
from shlex import quote
from textwrap import wrap

from rich.console import Console
from rich.text import Text

from rack.tools.console.answer import Document
from rack.tools.console.tables import Cell, TextTable, format_figure, render_text
from rack.tools.report.facts import Row, list_facts, list_reasons
from rack.tools.report.miss_causes import CORE_TAKEN, HYPERVISOR, NOT_RECORDED
from rack.tools.report.report_markdown import format_comparison
from rack.tools.report.run_report import RunReport

WIDTH = 80
"""Width of the summary. A narrower terminal gets more lines."""
MIN_WIDTH = 40
MAX_LINES = 25
MAX_PART_LINES = 5
"""Largest number of lines with reasons, and of lines with causes and responses."""
MAX_ROW_LINES = 3
MIN_TABLE_LINES = 5
INDENT = " " * 10
"""Space for the labels."""
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
    max_lines, max_part_lines = (ceil(WIDTH / width) * n for n in (MAX_LINES, MAX_PART_LINES))
    # Those that lost most cycles come first, then those that use most of their cycle.
    tasks = sorted(
        report.tasks.items(), key=lambda item: (_count_losses(item[1]), _compute_use(item[1]))
    )[::-1]
    lines = _format_headline(report, width, *tasks[0])
    lines += [*_format_rows(list_reasons(report), width, max_part_lines), ""]
    causes = _format_rows(_list_causes(report, *tasks[0]), width, max_part_lines)
    end = ["", *causes, *_list_files(report)]
    max_lines -= len(lines) + len(end)
    facts = _format_rows(list_facts(report), width, max_lines - MIN_TABLE_LINES - 1)
    facts += [""] * bool(facts)
    return [*lines, *facts, *_format_tasks(report, tasks, width, max_lines - len(facts)), *end]


def _format_rows(rows: Iterable[Row], width: int, max_lines: int) -> list[str]:
    """Format rows as aligned lines, and say how many lines do not fit."""
    lines = [
        line
        for label, clauses in rows
        for line in wrap(
            "; ".join(filter(None, clauses)),
            width,
            initial_indent=f"{label:{len(INDENT)}}",
            subsequent_indent=INDENT,
            break_long_words=False,
            break_on_hyphens=False,
            max_lines=MAX_ROW_LINES * ceil(WIDTH / width),
            placeholder=" ... see --full",
        )
    ]
    if (hidden := len(lines) - max_lines) > 0:
        lines[max_lines - 1 :] = [f"{INDENT}{hidden + 1} more lines: see --full"]
    return lines


def _find_verdict(report: RunReport) -> str:
    """Return the verdict. It is never DONE if something was left out of it."""
    outcome = report.outcome or {"cause": "", "faults": ()}
    if report.failures:
        is_stopped = outcome["cause"] == "stopped" and not outcome["faults"]
        return "STOPPED" if is_stopped and len(report.failures) == 1 else "FAILED"
    if report.unjudged or report.kept or report.rows_lost or report.recording != "complete":
        return "PARTLY JUDGED"
    return "DONE" if outcome["cause"] == "task done" else "TIME OVER"


def _format_headline(report: RunReport, width: int, name: str, task: Document) -> list[str]:
    """Return the verdict with the simulated time, and the losses of the worst task.

    Args:
        report: The report.
        width: Number of columns.
        name: Name of the worst task.
        task: Its entry in the report.
    """
    verdict = _find_verdict(report)
    if verdict == "PARTLY JUDGED":
        verdict += f", {report.outcome['cause']},"
    mode, right = "lockstep", "timing: no deadlines in lockstep"
    if report.mode != "lockstep":
        mode = "real time" if report.speed == 1.0 else f"real time x {report.speed:g}"
    if report.takes_time:
        right = "timing: no cycle missed"
    if _count_losses(task):
        verb = "missed" if task["missed"] else "skipped"
        due = task.get("due") or task["traced"] + task["skipped"]
        right = f"timing: {name} {verb} {task[verb]:,} of {due:,} cycles"
    word = "in" if verdict == "DONE" else "after"
    left = f"{report.rack}: {verdict} {word} {report.simulated_s:g} s ({mode})"
    if len(left) + len(right) < width - 1:
        return [f"{left}{right:>{width - len(left)}}"]
    return [*wrap(left, width), *wrap(right, width)]


def _count_losses(task: Document) -> int:
    """Return the number of missed and skipped cycles of a task."""
    return int(task.get("missed", 0) + task.get("skipped", 0))


def _compute_use(task: Document) -> float:
    """Return the percentage of its cycle or slice that a task uses: p99 of its processor time."""
    times = task.get("processor_ms")
    return 100.0 * times["p99"] / task["slice_ms"] if times else 0.0


def _format_tasks(
    report: RunReport, tasks: Sequence[tuple[str, Document]], width: int, max_lines: int
) -> list[str]:
    """Return the table of tasks. Its last line is about the tasks that do not fit.

    Args:
        report: The report.
        tasks: The tasks in the order of the table.
        width: Number of columns.
        max_lines: Largest number of lines.
    """
    shown = len(tasks) if len(tasks) < max_lines else max_lines - 1 - ceil(WIDTH / width)
    rows: list[dict[str, Cell]] = []
    for name, task in tasks[:shown]:
        times = task.get("processor_ms")
        row: dict[str, Cell] = {"": f"{'!' if _count_losses(task) else ' '} {name}"}
        row["cycle ms"] = task.get("slice_ms") or 1e3 / task["rate_hz"]
        row["proc p99"] = format_figure(times, "p99", 2)
        row["used %"] = f"{_compute_use(task):.0f}" if times else None
        row |= {kind: task.get(kind) for kind in ("missed", "skipped")}
        if report.takes_time:
            row["late ms"] = format_figure(task.get("lateness_ms"), "max", 2)
        rows.append(row)
    lines = [*render_text([TextTable(rows, DROPPED)], width)]
    if others := [task for _, task in tasks[shown:]]:
        lossy = sum(map(bool, map(_count_losses, others))) or "none"
        most = f"at most {max(map(_compute_use, others)):.0f} % used"
        rest = f"{len(others)} more: {lossy} missed or skipped, {most}"
        lines += wrap(rest, width, initial_indent="  ", subsequent_indent="  ")
    return lines


def _list_causes(report: RunReport, name: str, task: Document) -> Iterator[Row]:
    """Yield the causes of lost cycles, whether the worst task fits, and the system response."""
    causes: Counter[str] = Counter()
    longest_ms: defaultdict[str, float] = defaultdict(float)
    for miss in report.misses or ():
        causes[miss["why"]] += miss["count"]
        longest_ms[miss["why"]] = max(longest_ms[miss["why"]], miss["why_ms"] or 0.0)
    # The recording may lack rows.
    causes[NOT_RECORDED] += max(0, report.missed + report.skipped - causes.total())
    clauses = [
        f"{count:,}: {why}" + f", up to {longest_ms[why]:.2g} ms" * (longest_ms[why] > 0.0)
        for why, count in causes.most_common()
        if count
    ]
    yield "cause", clauses
    times = task.get("processor_ms")
    if clauses and times and report.mode != "lockstep":
        fits = times["p50"] <= task["slice_ms"]
        verb = "fits" if fits else "is too long"
        is_outside = 2 * (causes[HYPERVISOR] + causes[CORE_TAKEN]) > causes.total()
        median = f"{name} {verb} (median {times['p50']:.2g} of {task['slice_ms']:g} ms)"
        yield "", [median, "the machine was late" * (fits and is_outside)]
    if report.system_response:
        yield "response", _list_responses(report.system_response)


def _list_responses(response: Document) -> Iterator[str]:
    """Yield a clause about the system response in each direction, ms of simulated time."""
    for direction in ("command", "status"):
        chains = [one[direction] for one in (response, *response["others"])]
        measured = [chain for chain in chains if chain["measured_ms"]]
        if not measured:
            yield f"{direction} not measured"
            continue
        # Among several chains, show one whose bound was exceeded, or else the longest.
        chain = max(measured, key=lambda chain: (bool(chain["beyond"]), chain["bound_ms"]))
        bound, beyond = chain["bound_ms"], chain["beyond"]
        verdict = " (no bound)" if response["crosses_racks"] else f" (bound {bound:g})"
        if beyond and not response["crosses_racks"]:
            times = "once" if len(beyond) == 1 else f"{len(beyond)} times"
            slow = max(beyond, key=lambda slow: slow["ms"])
            verdict = f", {slow['ms'] - bound:g} over its bound {times}, after tick {slow['tick']}"
        yield f"{direction} {chain['measured_ms']['max']:g} ms{verdict}"


def _list_files(report: RunReport) -> list[str]:
    """Return the folder of a run, and the commands that show more of it."""
    if (run := report.folder) is None:
        return ["files     none, not recorded"] * (report.recording == "none")
    return [
        f"files     {run} ({(report.bytes or 0) * 1e-6:.1f} MB)",
        f"next      rack report {quote(run)} --full",
        *(f"{INDENT}rack {command} {quote(run)}" for command in ("replay", "analyze")),
    ]
