"""A report as text: report.md with every column, and on a terminal as many as fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.console import Console

from rack.boards.events import Braking, braked_text
from rack.tools.console.answer import Document
from rack.tools.console.tables import Blocks, TextTable, figure, table
from rack.tools.live.holds import resume_command
from rack.tools.live.verdict import headline
from rack.tools.recording.recording import Gap
from rack.tools.timing.analysis.arm_outcome import outcome_text
from rack.tools.timing.analysis.report_timing import (
    SHOWN,
    misses_text,
    response_text,
    the_most,
    times_text,
)
from rack.tools.timing.analysis.run_report import RunReport

CHANGED = 1.05
"""Ratio of a core's highest to its lowest frequency from which the text mentions it."""

FAULTS = (
    "fault",
    "target",
    "at tick",
    "found as",
    "after",
    "bound",
    "reactions",
    "recovered after",
)


def markdown(report: Document) -> str:
    """Return report.md of a report."""
    blocks = (
        block.markdown() if isinstance(block, TextTable) else (block,) for block in _blocks(report)
    )
    return "\n".join(line for lines in blocks for line in lines) + "\n"


def show(report: Document, terminal: Console) -> None:
    """Print as much of a report as the terminal's width permits."""
    for block in (*_blocks(report), "", _files(report)):
        is_title = isinstance(block, str) and block.startswith("#")
        lines = (
            table(block.head, block.rows, terminal.width, block.dropped)
            if isinstance(block, TextTable)
            else (block.lstrip("# "),)
        )
        for line in lines:
            terminal.print(line, style="bold" if is_title else "", highlight=False, markup=False)


def _files(report: Document) -> str:
    return f"all columns: {report['folder']}/report.md; all data: report.json"


def summary(document: Document) -> Iterator[str]:
    """Yield the verdict, and what is known of a run that was not recorded, too."""
    report = RunReport.of(document)
    yield f"# {headline(report.rack, report.outcome, report.failures)}"
    yield ""
    yield (
        f"{report.simulated_s:.2f} s simulated in {report.wall_s:.2f} s, {report.mode}, "
        f"{report.missed} missed, {report.skipped} skipped cycles."
        f"{f' Digest `{report.digest}`.' if report.digest else ''}"
    )
    yield from (f"- not judged: {line}" for line in report.unjudged)
    if found := (report.outcome or {}).get("brakings"):
        yield f"- {braked_text([Braking(**one) for one in found])}"


def _blocks(document: Document) -> Blocks:
    report = RunReport.of(document)
    yield from summary(document)
    yield from _notes(report)
    yield from outcome_text(report)
    yield from _queues(report.queues)
    yield from _interrupts(report.interrupts)
    if report.holds:
        yield from _holds(report)
    if report.state_tables:
        yield from _state_tables(report.state_tables)
    yield from times_text(report)
    yield from _faults(report)
    if report.misses:
        yield from misses_text(report)
    if report.system_response:
        yield from response_text(report.system_response)
    if report.entries:
        yield from ("", "## Bus adapters, ages in ms of simulated time", "")
        yield _passed(report.entries, ("superseded", "waiting", "source"))
    yield from _network(report.network)


def _notes(report: RunReport) -> Iterator[str]:
    """Yield what the run began from and ran on, and what the recording lacks."""
    if found := report.continues:
        yield f"- continues {found['folder']} from {found['time_s']:g} s"
    yield from (f"- {note}" for note in report.notes)
    yield from _machine(report)
    if report.recording != "complete":
        yield f"- recording: {report.recording}"
    if report.kept:
        yield f"- {report.kept}"
    if lost := ", ".join(f"{name} {count}" for name, count in report.rows_lost.items()):
        yield f"- the recorder lost rows: {lost}"
        yield from (f"- {Gap(**gap)}" for gap in report.gaps)
    if report.against:
        yield from _against(report.against)


def _holds(report: RunReport) -> Blocks:
    holds = report.holds
    yield from ("", f"## Holds: {len(holds)}{the_most(holds, 'longest')}", "")
    longest = sorted(holds, key=lambda hold: -hold["lasted_s"])[:SHOWN]
    rows = [
        [
            hold["level"],
            f"{'operator: ' if hold['by'] == 'operator' else ''}{hold['why']}",
            f"{hold['since_s']:.2f}",
            "the end" if hold["until_s"] is None else f"{hold['until_s']:.2f}",
            f"{hold['lasted_s']:.2f}",
        ]
        for hold in longest
    ]
    yield TextTable(("level", "by", "since, s", "until, s", "lasted, s"), rows)
    for level in (
        hold["level"] for hold in holds if hold["until_s"] is None and hold["by"] == "operator"
    ):
        yield from (
            "",
            (
                f"Still held at the end: {level}; `{resume_command(report.rack, level)}`"
                " releases it."
            ),
        )


def _state_tables(levels: dict[str, list[Document]]) -> Blocks:
    """Yield one line a level: the table, how many rows fired, and those that fired first and
    last."""
    yield from ("", "## State tables", "")
    rows = []
    for level, fired in levels.items():
        most = max(fired, key=lambda row: row["cycles"])
        last = fired[-1]
        tables = ", then ".join(dict.fromkeys(row["table"] for row in fired))
        count = [str(len(fired)), str(sum(row["cycles"] for row in fired))]
        ends = [f"{row['row']} {row['name']}, {row['first_s']:.2f} s" for row in (most, last)]
        rows.append([level, tables, *count, *ends])
    yield TextTable(
        ("level", "table", "rows fired", "cycles", "most often, since", "newest, since"), rows
    )


def _machine(report: RunReport) -> Iterator[str]:
    """Yield what the machine did to its cores: when they were away, by whom if that is known;
    changes of frequency."""
    steal = report.steal
    stalls = report.stalls
    frequency = report.frequency_mhz or {}
    lost = f"of {stalls['lost']} lost cycles were due meanwhile"
    if steal["ms"]:
        cores = ", ".join(f"core {core} for {steal['percent'][core]:.2f} %" for core in steal["ms"])
        yield f"- the hypervisor took {cores} of the run (steal); {stalls['during_steal']} {lost}"
    for away in stalls["absences"]:
        times = f"stalls: {away['times']}, longest {away['longest_ms']:.3g} ms"
        nothing = f"core {away['core']} ran nothing of the rack though it was due, without steal"
        yield f"- {nothing} ({times}); {away['lost']} {lost}"
    if quota := stalls["quota"]:
        causes = [*(f"the cycle of {level}" for level in quota["levels"]), "a quota of the host"]
        yield (
            f"- {quota['together']} of {quota['stalls']} stalls end at one phase of 100 ms:"
            f" {' or '.join(causes)}"
        )
    changed = {core: mhz for core, mhz in frequency.items() if mhz["max"] > CHANGED * mhz["min"]}
    if changed:
        cores = ", ".join(
            f"core {core} {mhz['min']:.0f} to {mhz['max']:.0f} MHz" for core, mhz in changed.items()
        )
        yield f"- the processor changed its frequency: {cores}"


def _against(against: Document) -> Iterator[str]:
    difference = against["first_difference"]
    if difference is None:
        yield f"- every message equals that of {against['folder']}"
        return
    missed = against["first_miss_tick"]
    why = f"the first miss is at tick {missed}" if missed is not None else "neither run has a miss"
    yield (
        f"- diverges from {against['folder']} at tick {difference['tick']}, first in"
        f" {difference['mailbox']}; {why}"
    )
    yield from (f"  - {line}" for line in against["why"])


def _faults(report: RunReport) -> Blocks:
    if faults := report.faults:
        yield from ("", f"## Faults: {len(faults)}", "")
        yield TextTable(FAULTS, [_fault_row(fault) for fault in faults])
    if restarts := ", ".join(f"{task} {count}" for task, count in report.restarts.items()):
        yield from ("", f"Restarts: {restarts}.")
    if unexplained := report.unexplained:
        yield from ("", f"## Unexplained detections: {len(unexplained)}", "")
        rows = [
            [str(found["tick"]), found["board"], found["code"], found["text"]]
            for found in unexplained
        ]
        yield TextTable(("tick", "found by", "as", "what"), rows)


def _fault_row(fault: Document) -> list[str]:
    subject = fault["mailbox"] or fault["joint"]
    is_struck = fault["seen"] != "not struck"
    found = (
        f"{fault['found_as']} by {fault['found_by']}"
        if fault["seen"] == "detected"
        else fault["seen"]
    )
    in_ms = fault["bound_ms"] is not None
    unit, after, bound = (
        ("ms", "delay_ms", "bound_ms") if in_ms else ("cycles", "delay_cycles", "bound_cycles")
    )
    recovered = "-" if fault["recovery_ms"] is None else f"{fault['recovery_ms']:.1f} ms"
    return [
        fault["kind"],
        f"{fault['board']} {subject}".strip(),
        str(fault["struck"]) if is_struck else "-",
        found,
        *("-" if fault[key] is None else f"{fault[key]:.3g} {unit}" for key in (after, bound)),
        ", ".join(fault["reactions"]) or "-",
        recovered if fault["is_recovered"] else "not recovered",
    ]


def _queues(queues: Sequence[Document]) -> Iterator[str]:
    for queue in queues:
        refused = f", {queue['refused']} refused" if queue["refused"] else ""
        yield (
            f"Queue {queue['mailbox']}: {queue['sent']} messages, {queue['taken']} of them read, at"
            f" most {queue['waiting']} waiting, room for {queue['capacity']}{refused}."
        )


def _interrupts(boards: Sequence[Document]) -> Iterator[str]:
    for board in boards:
        lost = f", {board['lost']} lost" if board["lost"] else ""
        latency = board["latency_us"]
        took = (
            f"; {latency['p50']:g} us from sending to the end of service, at most"
            f" {latency['max']:g}"
            if latency
            else ""
        )
        yield (
            f"Interrupts of {board['board']}: {board['served']} messages served, at most"
            f" {board['waiting']} waiting, room for {board['depth']}{lost}{took}."
        )


def _passed(rows: Sequence[Document], dropped: Sequence[str]) -> TextTable:
    """Return what passed from side to side, and its ages."""
    counts = [name for name in rows[0] if name != "age_ms"]
    ages = ("p50", "p99", "max")
    cells = [
        [*(str(row[name]) for name in counts), *(figure(row["age_ms"], key) for key in ages)]
        for row in rows
    ]
    return TextTable([*counts, *(f"age {key}" for key in ages)], cells, dropped)


def _network(network: Document | None) -> Blocks:
    """Yield what passed over the network, and how often other racks were lost."""
    if network is None:
        return
    yield from ("", "## Network, ages in ms of simulated time", "")
    if imports := network["imports"]:
        yield _passed(imports, ("disordered", "repeated", "superseded", "source"))
    for row in network["exports"]:
        yield f"- {row['entry']}: {row['source']} sent {row['sent']} times"
    for row in network["peers"]:
        times = (
            f"lost {row['losses']} times, {row['lost_s']:g} s; restarted {row['restarts']} times"
        )
        yield f"- rack {row['peer']}: {row['state']}; {times}"
