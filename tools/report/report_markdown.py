"""Formats a report as text: report.md with all columns, or for a terminal those that fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rack.boards.events import Braking, format_brakings
from rack.tools.console.answer import Document
from rack.tools.console.tables import (
    Blocks,
    Cell,
    TextTable,
    format_decimal,
    format_figure,
    render_markdown,
)
from rack.tools.launch.verdict import format_headline
from rack.tools.monitor.holds import format_resume_command
from rack.tools.recording.history import count_misses
from rack.tools.recording.recording import Gap
from rack.tools.report.arm_outcome import list_outcome_rows
from rack.tools.report.run_report import RunReport
from rack.tools.report.task_times import format_times

MAX_SHOWN_ROWS = 10
"""Largest number of misses, holds or long responses in the text. report.json contains all."""
VERDICT_WORDS = {True: "ok", False: "beyond", None: "-"}
CHANGED_RATIO = 1.05
"""Ratio of a core's highest to its lowest frequency above which the text mentions the core."""


def format_markdown(report: Document) -> str:
    """Return the text of report.md."""
    return render_markdown(format_report(report))


def format_for_terminal(report: Document) -> Blocks:
    """Yield a report for a terminal, and the names of the files that contain all data."""
    if report["folder"] is None:
        yield from format_summary(report)
        return
    yield from format_report(report)
    yield ""
    yield f"all columns: {report['folder']}/report.md; all data: report.json"


def format_summary(document: Document) -> Iterator[str]:
    """Yield the verdict, and the numbers that are known even for a run without a recording."""
    report = RunReport.from_document(document)
    yield f"# {format_headline(report.rack, report.outcome, report.failures)}"
    yield ""
    yield (
        f"{report.simulated_s:.2f} s simulated in {report.wall_s:.2f} s, {report.mode}, "
        f"{report.missed} missed, {report.skipped} skipped cycles."
        f"{f' Digest `{report.digest}`.' if report.digest else ''}"
    )
    yield from (f"- not judged: {line}" for line in report.unjudged)
    yield from (f"- rack {format_other_rack(other)}" for other in report.others)
    if brakings := (report.outcome or {}).get("brakings"):
        yield f"- {format_brakings([Braking(**braking) for braking in brakings])}"


def format_report(document: Document) -> Blocks:
    """Yield a report as human-readable text and tables."""
    report = RunReport.from_document(document)
    yield from format_summary(document)
    yield from _format_notes(report)
    yield ""
    for label, clauses in list_outcome_rows(report):
        yield f"{label.capitalize()}: {'; '.join(clauses)}."
    for end in report.objects:
        distance = f"{end['off_mm']:.1f} mm from its goal (tolerance {end['tolerance_mm']:g} mm)"
        yield f"Object {end['object']} ended {distance}."
        for drop in end.get("drops", ()):
            yield f"Object {end['object']} fell {drop['mm']:.0f} mm at tick {drop['tick']}."
    yield from (f"Queue {format_queue(queue)}." for queue in report.queues)
    yield from _format_interrupts(report.interrupts)
    if report.holds:
        yield from _format_holds(report.rack, report.holds)
    if report.state_tables:
        yield from ("", "## State tables", "", _build_state_table(report.state_tables))
    yield from format_times(report)
    yield from _format_faults(report)
    if report.misses:
        yield from _format_misses(report)
    if (response := report.system_response) is not None:
        yield from ("", "## System response, ms of simulated time")
        for chain in (response, *response["others"]):
            yield from _format_response(chain)
    if report.data_ages:
        yield from ("", "## Data ages of the boards' inputs, ms of simulated time", "")
        yield _build_traffic_table(report.data_ages, ("taken",))
    if report.entries:
        yield from ("", "## Bus adapters, ages in ms of simulated time", "")
        yield _build_traffic_table(report.entries, ("superseded", "waiting", "source"))
    yield from _format_network(report.network)


def _format_notes(report: RunReport) -> Iterator[str]:
    """Yield notes on the origin of the run, on the machine, and on gaps of the recording."""
    if origin := report.continues:
        yield f"- continues {origin['folder']} from {origin['time_s']:g} s"
    yield from (f"- {note}" for note in report.notes)
    yield from _format_machine(report)
    # A failure that names the missing rows has said this already.
    is_named = any(report.recording in why for why in report.failures)
    if report.recording != "complete" and not is_named:
        yield f"- recording: {report.recording}"
    if report.kept:
        yield f"- {report.kept}"
    lost = ", ".join(f"{name} {count}" for name, count in report.rows_lost.items())
    if lost and not is_named:
        yield f"- the recorder lost rows: {lost}"
        yield from (f"- {Gap(**gap)}" for gap in report.gaps)
    if report.against:
        yield from format_comparison(report.against)


def _format_selection(rows: Sequence[Any], which: str) -> str:
    """Return a suffix for a heading, which says which rows of a long table are shown.

    Args:
        rows: All rows.
        which: Adjective for the rows that are shown, for example "longest".

    Returns:
        The text, or "" if all rows are shown.
    """
    return f"; the {which} {MAX_SHOWN_ROWS}" if len(rows) > MAX_SHOWN_ROWS else ""


def _format_holds(rack: str, holds: Sequence[Document]) -> Blocks:
    """Yield the section on holds, with commands to release an operator's holds that never ended."""
    yield from ("", f"## Holds: {len(holds)}{_format_selection(holds, 'longest')}", "")
    rows = [
        {
            "level": hold["level"],
            "by": f"{'operator: ' if hold['by'] == 'operator' else ''}{hold['why']}",
            "since, s": format_decimal(hold["since_s"], 2),
            "until, s": "the end"
            if hold["until_s"] is None
            else format_decimal(hold["until_s"], 2),
            "lasted, s": format_decimal(hold["lasted_s"], 2),
        }
        for hold in sorted(holds, key=lambda hold: -hold["lasted_s"])[:MAX_SHOWN_ROWS]
    ]
    yield TextTable(rows)
    for hold in holds:
        if hold["until_s"] is None and hold["by"] == "operator":
            level = hold["level"]
            yield from (
                "",
                f"Still held at the end: {level}; `{format_resume_command(rack, level)}` "
                "releases it.",
            )


def _build_state_table(levels: dict[str, list[Document]]) -> TextTable:
    """Return a table of the levels that follow state tables.

    For each level it gives the number of state-table rows that fired, the most frequent row, and
    the row that was the last to fire for the first time.
    """
    rows = []
    for level, fired in levels.items():
        most_frequent = max(fired, key=lambda row: row["cycles"])
        often, newest = (
            f"{row['row']} {row['name']}, {row['first_s']:.2f} s"
            for row in (most_frequent, fired[-1])
        )
        rows.append(
            {
                "level": level,
                "table": ", then ".join(dict.fromkeys(row["table"] for row in fired)),
                "rows fired": len(fired),
                "cycles": sum(row["cycles"] for row in fired),
                "most often, since": often,
                "newest, since": newest,
            }
        )
    return TextTable(rows)


def _format_machine(report: RunReport) -> Iterator[str]:
    """Yield notes on times when a core was unavailable, and on changes of the core frequencies."""
    steal = report.steal
    stalls = report.stalls
    frequency = report.frequency_mhz or {}
    lost = f"of {stalls['lost']} lost cycles were due at these times"
    if steal["ms"]:
        cores = ", ".join(f"core {core} for {steal['percent'][core]:.2f} %" for core in steal["ms"])
        yield f"- the hypervisor took {cores} of the run (steal); {stalls['during_steal']} {lost}"
    for absence in stalls["absences"]:
        details = f"stalls: {absence['times']}, longest {absence['longest_ms']:.3g} ms"
        where = f"core {absence['core']} was away although no steal was counted"
        yield f"- {where} ({details}); {absence['lost']} {lost}"
    if quota := stalls["quota"]:
        causes = [*(f"the cycle of {level}" for level in quota["levels"]), "a quota of the host"]
        yield (
            f"- {quota['together']} of {quota['stalls']} stalls end at the same phase of a 100 ms"
            f" period, which suggests {' or '.join(causes)}"
        )
    changed = {
        core: mhz for core, mhz in frequency.items() if mhz["max"] > CHANGED_RATIO * mhz["min"]
    }
    if changed:
        cores = ", ".join(
            f"core {core} {mhz['min']:.0f} to {mhz['max']:.0f} MHz" for core, mhz in changed.items()
        )
        yield f"- the processor changed its frequency: {cores}"


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


def _format_faults(report: RunReport) -> Blocks:
    """Yield the sections on injected faults, restarts, and detections without a fault."""
    if faults := report.faults:
        yield from ("", f"## Faults: {len(faults)}", "")
        yield TextTable([_build_fault_row(fault) for fault in faults])
    if restarts := ", ".join(f"{task} {count}" for task, count in report.restarts.items()):
        yield from ("", f"Restarts: {restarts}.")
    if unexplained := report.unexplained:
        yield from ("", f"## Unexplained detections: {len(unexplained)}", "")
        columns = {"tick": "tick", "found by": "board", "as": "code", "what": "text"}
        yield TextTable(
            [{head: detection[key] for head, key in columns.items()} for detection in unexplained]
        )


def _build_fault_row(fault: Document) -> dict[str, Cell]:
    """Return the row of a fault in the table of faults."""
    unit = "cycles" if fault["bound_ms"] is None else "ms"
    after, bound = (
        "-" if fault[f"{key}_{unit}"] is None else f"{fault[f'{key}_{unit}']:.3g} {unit}"
        for key in ("delay", "bound")
    )
    recovered = "-" if fault["recovery_ms"] is None else f"{fault['recovery_ms']:.1f} ms"
    seen = fault["seen"]
    return {
        "fault": fault["kind"],
        "target": f"{fault['board']} {fault['mailbox'] or fault['joint']}".strip(),
        "at tick": None if seen == "not struck" else fault["struck"],
        "found as": (f"{fault['found_as']} by {fault['found_by']}" if seen == "detected" else seen),
        "after": after,
        "bound": bound,
        "reactions": ", ".join(fault["reactions"]) or None,
        "recovered after": recovered if fault["is_recovered"] else "not recovered",
    }


def _format_misses(report: RunReport) -> Blocks:
    """Yield the section with the first missed cycles, and the reason if some are not recorded."""
    misses = report.misses
    late, skipped = count_misses(misses)
    which = f"{late} and {skipped}{_format_selection(misses, 'first')}"
    yield from ("", f"## Missed and skipped cycles: {which}", "")
    if (late, skipped) != (report.missed, report.skipped):
        counts = f"{report.missed} and {report.skipped}"
        why = "the recording does not contain all of them"
        if report.rows_lost:
            why = "the recorder lost rows"
        yield from (f"The tasks counted {counts}; {why}.", "")
    rows = [
        {
            "tick": miss["tick"],
            "task": miss["task"],
            "what": miss["what"] if miss["what"] == "late" else f"{miss['count']} skipped",
            "started late, ms": format_decimal(miss.get("started_ms")),
            "took, ms": format_decimal(miss.get("took_ms")),
            "why": miss["why"] + (f", {miss['why_ms']:.3g} ms" if miss["why_ms"] else ""),
        }
        for miss in misses[:MAX_SHOWN_ROWS]
    ]
    yield TextTable(rows)


def _format_response(response: Document) -> Blocks:
    """Yield the system response along a chain of levels, and the responses beyond the bound."""
    yield ""
    bounds = (
        f"eq. 3.2 bound {response['bound_eq_3_2_ms']:g}, eq. 3.3 sum {response['sum_eq_3_3_ms']:g}"
    )
    yield (
        f"{' > '.join(response['levels'])}: {bounds}; on a fixed grid each level also waits for its"
        " cycle."
    )
    yield ""
    directions = {"command, down": response["command"], "status, up": response["status"]}
    rows = [
        {
            "way": (
                direction
                if len(measured["levels"]) == len(response["levels"])
                else f"{direction} from {measured['levels'][0]}"
            ),
            "measured p50": format_figure(measured["measured_ms"], "p50"),
            "measured max": format_figure(measured["measured_ms"], "max"),
            "bound": measured["bound_ms"],
            "": VERDICT_WORDS[measured["holds"]],
        }
        for direction, measured in directions.items()
        if measured["levels"]
    ]
    yield TextTable(rows)
    for direction, measured in directions.items():
        if exceeding := measured["beyond"]:
            selection = _format_selection(exceeding, "longest")
            yield from ("", f"{direction}: {len(exceeding)} exceeded the bound{selection}:")
        for slow in sorted(exceeding, key=lambda slow: -slow["ms"])[:MAX_SHOWN_ROWS]:
            causes = [*slow["delayed_by"], *slow.get("network", ())]
            why = "; ".join(causes) or "no cause is recorded"
            yield f"- {slow['ms']:g} ms from tick {slow['tick']}: {why}"
        if unseen := measured["unseen"]:
            yield from ("", f"{direction}: {unseen} not measured, because messages are missing.")


def format_queue(queue: Document) -> str:
    """Return a clause about the messages of a queue."""
    refused = f", {queue['refused']} refused" if queue["refused"] else ""
    return (
        f"{queue['mailbox']}: {queue['sent']} messages, {queue['taken']} of them read, at"
        f" most {queue['waiting']} waiting, room for {queue['capacity']}{refused}"
    )


def _format_interrupts(boards: Sequence[Document]) -> Iterator[str]:
    """Yield a sentence about the interrupts of each board: number and latency."""
    for board in boards:
        lost = f", {board['lost']} lost" if board["lost"] else ""
        latency = board["latency_us"]
        latency_clause = (
            f"; {latency['p50']:g} us from sending to the end of service, at most"
            f" {latency['max']:g}"
            if latency
            else ""
        )
        yield (
            f"Interrupts of {board['board']}: {board['served']} messages served, at most"
            f" {board['waiting']} waiting, room for {board['depth']}{lost}{latency_clause}."
        )


def _build_traffic_table(rows: Sequence[Document], dropped: Sequence[str]) -> TextTable:
    """Return a table of the messages that passed an adapter, with their ages.

    Args:
        rows: Counts and age distribution of each mailbox.
        dropped: Columns that a narrow terminal leaves out, in that order.
    """
    cells = [
        {
            **{name: count for name, count in row.items() if name != "age_ms"},
            **{f"age {key}": format_figure(row["age_ms"], key) for key in ("p50", "p99", "max")},
        }
        for row in rows
    ]
    return TextTable(cells, dropped)


def _format_network(network: Document | None) -> Blocks:
    """Yield the section on traffic with other racks, and on losses of contact with them."""
    if network is None:
        return
    yield from ("", "## Network, ages in ms of simulated time", "")
    if imports := network["imports"]:
        yield _build_traffic_table(imports, ("disordered", "repeated", "superseded", "source"))
    for row in network["exports"]:
        yield f"- {row['entry']}: {row['source']} sent {row['sent']} times"
    yield from (f"- rack {format_peer(peer)}" for peer in network["peers"])


def format_peer(row: Document) -> str:
    """Return a clause about the contact with another rack."""
    times = f"lost {row['losses']} times, {row['lost_s']:g} s; restarted {row['restarts']} times"
    return f"{row['peer']}: {row['state']}; {times}"


def format_other_rack(end: Document) -> str:
    """Return a clause about the end of a rack that was launched with this one."""
    return f"{end['rack']}: {end['cause']} after {end['ticks']} ticks, {end['folder']}"
