"""Formats a report as text: the facts, then a table about each subject, with the JSON's keys."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rack.tools.console.answer import Document
from rack.tools.console.tables import Blocks, Cell, TextTable, format_cell, render_markdown
from rack.tools.launch.verdict import format_headline
from rack.tools.monitor.holds import format_resume_command
from rack.tools.recording.history import count_misses
from rack.tools.report.facts import list_facts, list_reasons
from rack.tools.report.run_report import RunReport
from rack.tools.report.task_times import format_times

MAX_ROWS = 10
"""Largest number of rows of a table. report.json contains all."""
SHOWN_PARTS = ("p50", "p99", "max")
"""Parts of a distribution that have a column."""
FAULT_COLUMNS = (
    *("kind", "board", "mailbox", "joint", "struck", "seen", "found_by", "found_as"),
    *("delay_ms", "bound_ms", "delay_cycles", "bound_cycles", "reactions", "recovery_ms"),
    "is_recovered",
)
DROPPED = (
    *("found_by", "mailbox", "joint", "reactions", "seen", "bound_cycles", "delay_cycles"),
    *("superseded", "disordered", "repeated", "waiting", "source", "taken", "served", "depth"),
    *("sum_eq_3_3_ms", "bound_eq_3_2_ms", "measured_ms p99", "unseen", "age_ms p99"),
    *("count", "took_ms", "started_ms"),
)
"""Columns that a narrow terminal leaves out, in this order."""
NOT_TABULATED = "levels", "beyond", "count", "parts", "uncertainty_ms"
"""Keys of a measured response that have no column."""


def format_markdown(report: Document) -> str:
    """Return the text of report.md."""
    return render_markdown(format_report(report))


def format_report(document: Document) -> Blocks:
    """Yield a report as human-readable text and tables."""
    report = RunReport.from_document(document)
    yield f"# {format_headline(report.rack, report.outcome, report.failures)}"
    yield ""
    yield (
        f"{report.simulated_s:.2f} s simulated in {report.wall_s:.2f} s, {report.mode}, "
        f"{report.missed} missed, {report.skipped} skipped cycles."
    )
    yield f"Digest `{report.digest or 'unknown'}`."
    for label, clauses in (*list_reasons(report), *list_facts(report)):
        # The headline names the failures.
        if label != "because" and (text := "; ".join(filter(None, clauses))):
            yield f"- {label}: {text}"
    if report.folder is None:
        return
    yield from _format_machine(report)
    if report.against:
        yield from format_comparison(report.against)
    yield from _format_section("Objects", report.objects)
    yield from _format_holds(report.rack, report.holds)
    fired = report.state_tables.items()
    rows = [{"level": level, **row} for level, level_rows in fired for row in level_rows]
    yield from _format_section("State tables: rows that fired", rows)
    yield from format_times(report)
    faults = [{column: fault[column] for column in FAULT_COLUMNS} for fault in report.faults]
    yield from _format_section("Faults", faults)
    yield from _format_section("Detections without a fault", report.unexplained)
    yield from _format_section("Missed and skipped cycles", report.misses)
    if count_misses(report.misses) != (report.missed, report.skipped):
        counts = f"The tasks counted {report.missed} and {report.skipped} lost cycles"
        yield from ("", f"{counts}; the recording does not contain all of them.")
    if response := report.system_response:
        yield from _format_responses([response, *response["others"]])
    network = report.network or {}
    for title, records in {
        "Queues": report.queues,
        "Interrupts of boards": report.interrupts,
        "Data ages of the boards' inputs": report.data_ages or (),
        "Entries of bus adapters": report.entries,
        **{f"Network: {what}": network.get(what, ()) for what in ("imports", "exports", "peers")},
    }.items():
        yield from _format_section(title, records)
    yield from ("", f"all columns: {report.folder}/report.md; all data: report.json")


def _format_section(title: str, records: Sequence[Mapping[str, Any]]) -> Blocks:
    """Yield a title and a table of the first records, or nothing without records.

    The columns are the keys of the records, except for those without any value.
    """
    if not records:
        return
    rows = [dict(_list_cells(record)) for record in records[:MAX_ROWS]]
    columns = dict.fromkeys(column for row in rows for column in row)
    which = f"; the first {MAX_ROWS}" if len(records) > MAX_ROWS else ""
    yield from ("", f"## {title}: {len(records)}{which}", "")
    yield TextTable([{name: row.get(name) for name in columns} for row in rows], DROPPED)


def _list_cells(record: Mapping[str, Any]) -> Iterator[tuple[str, Cell]]:
    """Yield column and cell of each value of a record. A distribution has several columns."""
    for key, value in record.items():
        if isinstance(value, dict):
            yield from ((f"{key} {part}", value[part]) for part in SHOWN_PARTS)
        elif value not in (None, "", []):
            is_list = isinstance(value, list)
            yield key, "; ".join(map(_format_item, value)) if is_list else value


def _format_item(item: Any) -> str:
    """Format an item of a list, which may be a record, as text."""
    if isinstance(item, dict):
        return ", ".join(f"{key} {format_cell(value)}" for key, value in item.items())
    return format_cell(item)


def _format_holds(rack: str, holds: Sequence[Document]) -> Blocks:
    """Yield the section on holds, with commands to release an operator's holds that never ended."""
    longest = sorted(holds, key=lambda hold: -hold["lasted_s"])
    yield from _format_section("Holds, longest first", longest)
    for hold in holds:
        if hold["until_s"] is None and hold["by"] == "operator":
            command = format_resume_command(rack, hold["level"])
            yield from ("", f"Still held at the end: {hold['level']}; `{command}` releases it.")


def _format_machine(report: RunReport) -> Iterator[str]:
    """Yield notes on times when a core was unavailable."""
    steal, stalls = report.steal, report.stalls
    lost = f"of {stalls['lost']} lost cycles were due at these times"
    if steal["ms"]:
        cores = ", ".join(f"core {core} for {steal['percent'][core]:.2f} %" for core in steal["ms"])
        yield f"- the hypervisor took {cores} of the run (steal); {stalls['during_steal']} {lost}"
    for away in stalls["absences"]:
        yield (
            f"- core {away['core']} was away although no steal was counted (stalls:"
            f" {away['times']}, longest {away['longest_ms']:.3g} ms); {away['lost']} {lost}"
        )


def format_comparison(against: Document) -> Iterator[str]:
    """Yield lines on where and why the run diverges from another run."""
    difference = against["first_difference"]
    if difference is None:
        yield f"- no message differs from {against['folder']}"
        return
    missed = against["first_miss_tick"]
    why = f"the first miss is at tick {missed}" if missed is not None else "neither run has a miss"
    yield (
        f"- diverges from {against['folder']} at tick {difference['tick']}, first in"
        f" {difference['mailbox']}; {why}"
    )
    yield from (f"  - {line}" for line in against["why"])


def _format_responses(chains: Sequence[Document]) -> Blocks:
    """Yield the sections on the system response along chains of levels."""
    rows = []
    beyond = []
    for chain in chains:
        for direction in ("command", "status"):
            if levels := chain[direction]["levels"]:
                way = {"way": f"{direction}, {levels[0]} to {levels[-1]}"}
                bounds = {key: chain[key] for key in ("bound_eq_3_2_ms", "sum_eq_3_3_ms")}
                rows.append(way | chain[direction] | bounds | dict.fromkeys(NOT_TABULATED))
                beyond += [way | slow for slow in chain[direction]["beyond"]]
    yield from _format_section("System response, ms of simulated time", rows)
    beyond.sort(key=lambda slow: -slow["ms"])
    yield from _format_section("Responses beyond their bound, longest first", beyond)
