"""Formats a report as text: the facts, then a section with a table about each subject."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

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
from rack.tools.report.facts import list_facts, list_reasons
from rack.tools.report.run_report import RunReport
from rack.tools.report.task_times import format_times

MAX_SHOWN_ROWS = 10
"""Largest number of misses, holds or long responses in the text. report.json contains all."""
VERDICT_WORDS = {True: "ok", False: "beyond", None: "-"}
DETECTION_COLUMNS = {"tick": "tick", "found by": "board", "as": "code", "what": "text"}
CHANGED_RATIO = 1.05
"""Ratio of a core's highest to its lowest frequency above which the text mentions the core."""


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
    goal = "- {object}: {off_mm:.1f} mm from its goal (tolerance {tolerance_mm:g} mm)"
    yield from map(goal.format_map, report.objects)
    for end in report.objects:
        for drop in end.get("drops", ()):
            yield f"- {end['object']} fell {drop['mm']:.0f} mm at tick {drop['tick']}"
    yield from _format_machine(report)
    if report.against:
        yield from format_comparison(report.against)
    yield from map(_format_queue, report.queues)
    yield from map(_format_interrupts, report.interrupts)
    yield from _format_holds(report.rack, report.holds)
    yield from _format_section(
        "State tables", [*map(_build_state_row, report.state_tables.items())]
    )
    yield from format_times(report)
    faults = [*map(_build_fault_row, report.faults)]
    yield from _format_section(f"Faults: {len(faults)}", faults)
    found = [
        {head: detection[key] for head, key in DETECTION_COLUMNS.items()}
        for detection in report.unexplained
    ]
    yield from _format_section(f"Unexplained detections: {len(found)}", found)
    yield from _format_misses(report)
    if response := report.system_response:
        yield from ("", "## System response, ms of simulated time")
        for chain in (response, *response["others"]):
            yield from _format_response(chain)
    title = "Data ages of the boards' inputs, ms of simulated time"
    rows = [*map(_build_traffic_row, report.data_ages or ())]
    yield from _format_section(title, rows, ("taken",))
    title = "Bus adapters, ages in ms of simulated time"
    dropped = ("superseded", "waiting", "source")
    yield from _format_section(title, [*map(_build_traffic_row, report.entries)], dropped)
    if report.network:
        yield from _format_network(report.network)
    yield from ("", f"all columns: {report.folder}/report.md; all data: report.json")


def _format_section(
    title: str, rows: Sequence[Mapping[str, Cell]], dropped: Sequence[str] = ()
) -> Blocks:
    """Yield a title and a table, or nothing for a table without rows.

    Args:
        title: Title of the section.
        rows: Rows of the table.
        dropped: Columns that a narrow terminal leaves out, in that order.
    """
    if rows:
        yield from ("", f"## {title}", "", TextTable(rows, dropped))


def _format_selection(rows: Sequence[Any], which: str) -> str:
    """Return a suffix for a title: which rows of a long table are shown, for example "first"."""
    return f"; the {which} {MAX_SHOWN_ROWS}" if len(rows) > MAX_SHOWN_ROWS else ""


def _format_holds(rack: str, holds: Sequence[Document]) -> Blocks:
    """Yield the section on holds, with commands to release an operator's holds that never ended."""
    rows: list[dict[str, Cell]] = [
        {
            "level": hold["level"],
            "by": f"{'operator: ' if hold['by'] == 'operator' else ''}{hold['why']}",
            "since, s": format_decimal(hold["since_s"], 2),
            "until, s": "the end" if until is None else format_decimal(until, 2),
            "lasted, s": format_decimal(hold["lasted_s"], 2),
        }
        for hold in sorted(holds, key=lambda hold: -hold["lasted_s"])[:MAX_SHOWN_ROWS]
        for until in [hold["until_s"]]
    ]
    yield from _format_section(f"Holds: {len(holds)}{_format_selection(holds, 'longest')}", rows)
    for hold in holds:
        if hold["until_s"] is None and hold["by"] == "operator":
            command = format_resume_command(rack, hold["level"])
            yield from ("", f"Still held at the end: {hold['level']}; `{command}` releases it.")


def _build_state_row(item: tuple[str, list[Document]]) -> dict[str, Cell]:
    """Return the row of a level that follows state tables.

    It gives the number of state-table rows that fired, the most frequent row, and the row that was
    the last to fire for the first time.
    """
    level, fired = item
    text = "{row} {name}, {first_s:.2f} s"
    return {
        "level": level,
        "table": ", then ".join(dict.fromkeys(row["table"] for row in fired)),
        "rows fired": len(fired),
        "cycles": sum(row["cycles"] for row in fired),
        "most often, since": text.format(**max(fired, key=lambda row: row["cycles"])),
        "newest, since": text.format(**fired[-1]),
    }


def _format_machine(report: RunReport) -> Iterator[str]:
    """Yield notes on times when a core was unavailable, and on changes of the core frequencies."""
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
    if quota := stalls["quota"]:
        causes = [*(f"the cycle of {level}" for level in quota["levels"]), "a quota of the host"]
        yield (
            f"- {quota['together']} of {quota['stalls']} stalls end at the same phase of a 100 ms"
            f" period, which suggests {' or '.join(causes)}"
        )
    changed = [
        f"core {core} {mhz['min']:.0f} to {mhz['max']:.0f} MHz"
        for core, mhz in (report.frequency_mhz or {}).items()
        if mhz["max"] > CHANGED_RATIO * mhz["min"]
    ]
    if changed:
        yield f"- the processor changed its frequency: {', '.join(changed)}"


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
    """Yield the section with the first missed cycles, and whether some are not recorded."""
    misses = report.misses
    rows: list[dict[str, Cell]] = [
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
    late, skipped = count_misses(misses)
    which = f"{late} and {skipped}{_format_selection(misses, 'first')}"
    yield from _format_section(f"Missed and skipped cycles: {which}", rows)
    if (late, skipped) != (report.missed, report.skipped):
        counts = f"The tasks counted {report.missed} and {report.skipped} lost cycles"
        yield from ("", f"{counts}; the recording does not contain all of them.")


def _format_response(response: Document) -> Blocks:
    """Yield the system response along a chain of levels, and the responses beyond the bound."""
    levels = " > ".join(response["levels"])
    yield ""
    yield (
        f"{levels}: eq. 3.2 bound {response['bound_eq_3_2_ms']:g}, eq. 3.3 sum"
        f" {response['sum_eq_3_3_ms']:g}; on a fixed grid each level also waits for its cycle."
    )
    yield ""
    directions = {"command, down": response["command"], "status, up": response["status"]}
    yield TextTable(
        [
            {
                "way": f"{direction} from {measured['levels'][0]}",
                "measured p50": format_figure(measured["measured_ms"], "p50"),
                "measured max": format_figure(measured["measured_ms"], "max"),
                "bound": measured["bound_ms"],
                "": VERDICT_WORDS[measured["holds"]],
            }
            for direction, measured in directions.items()
            if measured["levels"]
        ]
    )
    for direction, measured in directions.items():
        if exceeding := measured["beyond"]:
            selection = _format_selection(exceeding, "longest")
            yield from ("", f"{direction}: {len(exceeding)} exceeded the bound{selection}:")
        for slow in sorted(exceeding, key=lambda slow: -slow["ms"])[:MAX_SHOWN_ROWS]:
            why = "; ".join(slow["delayed_by"] + slow["network"]) or "no cause is recorded"
            yield f"- {slow['ms']:g} ms from tick {slow['tick']}: {why}"
        if unseen := measured["unseen"]:
            yield from ("", f"{direction}: {unseen} not measured, because messages are missing.")


def _format_queue(queue: Document) -> str:
    """Return a line about the messages of a queue."""
    refused = f", {queue['refused']} refused" if queue["refused"] else ""
    return (
        f"- queue {queue['mailbox']}: {queue['sent']} messages, {queue['taken']} of them read, at"
        f" most {queue['waiting']} waiting, room for {queue['capacity']}{refused}"
    )


def _format_interrupts(board: Document) -> str:
    """Return a line about the interrupts of a board: number and latency."""
    lost = f", {board['lost']} lost" if board["lost"] else ""
    measured = ""
    if us := board["latency_us"]:
        measured = f"; {us['p50']:g} us from sending to the end of service, at most {us['max']:g}"
    return (
        f"- interrupts of {board['board']}: {board['served']} messages served, at most"
        f" {board['waiting']} waiting, room for {board['depth']}{lost}{measured}"
    )


def _build_traffic_row(traffic: Document) -> dict[str, Cell]:
    """Return the row of an entry of an adapter, with the ages of its messages."""
    ages = {f"age {key}": format_figure(traffic["age_ms"], key) for key in ("p50", "p99", "max")}
    return {name: count for name, count in traffic.items() if name != "age_ms"} | ages


def _format_network(network: Document) -> Blocks:
    """Yield the section on traffic with other racks, and on losses of contact with them."""
    yield from ("", "## Network, ages in ms of simulated time", "")
    dropped = ("disordered", "repeated", "superseded", "source")
    yield TextTable([*map(_build_traffic_row, network["imports"])], dropped)
    yield from map("- {entry}: {source} sent {sent} times".format_map, network["exports"])
    peer = "- rack {peer}: {state}; lost {losses} times, {lost_s:g} s; restarted {restarts} times"
    yield from map(peer.format_map, network["peers"])
