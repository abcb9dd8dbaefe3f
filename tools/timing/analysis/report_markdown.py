"""A report as text: report.md with every column, and on a terminal as many as fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console

from rack.boards.events import Braking, braked_text
from rack.tools.console.tables import decimal, figure, markdown_table, table
from rack.tools.live.holds import resume_command
from rack.tools.recording.history import counted
from rack.tools.recording.recording import Gap

Report = dict[str, Any]

SHOWN = 10
"""Most misses, holds and long responses in the text; report.json has them all."""

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
COUNTS = ("task", "R", "cycles", "missed", "skipped")
BY_THE_CLOCK = ("late p50", "late p99", "late max", "residual min", "deviation", "alpha")
"""Times relative to a release or a time slice: they mean nothing in lockstep."""
USED = ("exec p50", "exec p99", "exec max", "comm p99", "proc p99", "plan age max")
JUDGED = {True: "ok", False: "FAILS", None: "-"}
DROPPED = (
    *("deviation", "comm p99", "proc p99", "late p50", "exec p50", "alpha", "late p99", "exec p99"),
    *("plan age max", "R", "cycles"),
)
"""Columns that a narrow terminal leaves out, the first of them first."""


@dataclass(frozen=True)
class Grid:
    """A table; `dropped` are columns that a narrow terminal leaves out, the first of them first."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    dropped: Sequence[str] = ()

    def markdown(self) -> Iterator[str]:
        """Yield all of it in Markdown."""
        return markdown_table(self.head, self.rows)


def markdown(report: Report) -> str:
    """Return report.md of a report."""
    blocks = (
        block.markdown() if isinstance(block, Grid) else (block,) for block in _blocks(report)
    )
    return "\n".join(line for lines in blocks for line in lines) + "\n"


def show(report: Report, terminal: Console) -> None:
    """Print as much of a report as the terminal's width permits."""
    for block in _blocks(report):
        if isinstance(block, Grid):
            for line in table(block.head, block.rows, terminal.width, block.dropped):
                terminal.print(line, highlight=False, markup=False)
        else:
            style = "bold" if block.startswith("#") else ""
            terminal.print(block.lstrip("# "), style=style, highlight=False, markup=False)
    terminal.print(
        f"\nall columns: {report['folder']}/report.md; all data: report.json",
        highlight=False,
        markup=False,
    )


def _blocks(report: Report) -> Iterator[str | Grid]:
    outcome = report["outcome"] or {"cause": "no outcome recorded", "reason": "", "faults": []}
    why = outcome["reason"] or "; ".join(outcome["faults"])
    yield f"# {report['rack']}: {outcome['cause']}{': ' + why if why else ''}"
    yield ""
    yield (
        f"{report['simulated_s']:.2f} s simulated in {report['wall_s']:.2f} s, {report['mode']}, "
        f"{report['missed']} missed, {report['skipped']} skipped cycles."
        f"{' Digest `' + report['digest'] + '`.' if report['digest'] else ''}"
    )
    yield from (f"- fault: {fault}" for fault in outcome["faults"])
    if found := outcome.get("brakings"):
        yield f"- {braked_text([Braking(**one) for one in found])}"
    yield from (f"- {note}" for note in report["notes"])
    yield from _machine(report)
    if report["recording"] != "complete":
        yield f"- recording: {report['recording']}"
    if report["kept"]:
        yield f"- {report['kept']}"
    if lost := ", ".join(f"{name} {count}" for name, count in report["rows_lost"].items()):
        yield f"- the recorder lost rows: {lost}"
        yield from (f"- {Gap(**gap)}" for gap in report["gaps"])
    yield from _against(report.get("against"))
    yield from _task(report["task"])
    yield from _objects(report["objects"])
    yield from _motion(report["motion"])
    yield from _hand(report["hand"])
    yield from _force(report["force"])
    yield from _queues(report["queues"])
    yield from _interrupts(report["interrupts"])
    yield from _holds(report)
    yield from _state_tables(report["state_tables"])
    yield from _times(report)
    yield from _faults(report)
    yield from _misses(report)
    yield from _response(report["system_response"])
    yield from _entries(report["entries"])
    yield from _network(report["network"])


def _times(report: Report) -> Iterator[str | Grid]:
    is_lockstep = report["mode"] == "lockstep"
    yield from ("", "## Cycles, ms", "")
    if is_lockstep:
        yield (
            "In lockstep a tick lasts as long as its tasks take: there are no deadlines, no"
            " lateness, no residuals."
        )
        yield ""
    for name, (traced, ran) in report["untraced"].items():
        yield from (f"Times of {name} are from {traced:,} of {ran:,} cycles.", "")
    head = (*COUNTS, *(() if is_lockstep else BY_THE_CLOCK), *USED)
    cells = [_times_row(name, task) for name, task in report["tasks"].items()]
    yield Grid(head, [[row[name] for name in head] for row in cells], DROPPED)


def _holds(report: Report) -> Iterator[str | Grid]:
    holds = report["holds"]
    if not holds:
        return
    yield from ("", f"## Holds: {len(holds)}{_first(holds, 'longest')}", "")
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
    yield Grid(("level", "by", "since, s", "until, s", "lasted, s"), rows)
    for level in (
        hold["level"] for hold in holds if hold["until_s"] is None and hold["by"] == "operator"
    ):
        yield from (
            "",
            (
                f"Still held at the end: {level}; `{resume_command(report['rack'], level)}`"
                " releases it."
            ),
        )


def _state_tables(levels: dict[str, list[Report]]) -> Iterator[str | Grid]:
    """Yield one line a level: the table, how many rows fired, and those that fired first and
    last."""
    if not levels:
        return
    yield from ("", "## State tables", "")
    rows = []
    for level, fired in levels.items():
        most = max(fired, key=lambda row: row["cycles"])
        last = fired[-1]
        tables = ", then ".join(dict.fromkeys(row["table"] for row in fired))
        count = [str(len(fired)), str(sum(row["cycles"] for row in fired))]
        ends = [f"{row['row']} {row['name']}, {row['first_s']:.2f} s" for row in (most, last)]
        rows.append([level, tables, *count, *ends])
    yield Grid(
        ("level", "table", "rows fired", "cycles", "most often, since", "newest, since"), rows
    )


def _first(rows: Sequence[Any], which: str) -> str:
    return f"; the {which} {SHOWN}" if len(rows) > SHOWN else ""


def _machine(report: Report) -> Iterator[str]:
    """Yield what the machine did to its cores: when they were away, by whom if that is known;
    changes of frequency."""
    steal = report["steal"]
    stalls = report["stalls"]
    frequency = report["frequency_mhz"] or {}
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


def _against(against: Report | None) -> Iterator[str]:
    if against is None:
        return
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


def _faults(report: Report) -> Iterator[str | Grid]:
    faults = report["faults"]
    unexplained = report["unexplained"]
    restarts = report["restarts"]
    if faults:
        yield from ("", f"## Faults: {len(faults)}", "")
        yield Grid(FAULTS, [_fault_row(fault) for fault in faults])
    if restarts:
        yield from (
            "",
            f"Restarts: {', '.join(f'{task} {count}' for task, count in restarts.items())}.",
        )
    if unexplained:
        yield from ("", f"## Unexplained detections: {len(unexplained)}", "")
        rows = [
            [str(found["tick"]), found["board"], found["code"], found["text"]]
            for found in unexplained
        ]
        yield Grid(("tick", "found by", "as", "what"), rows)


def _fault_row(fault: Report) -> list[str]:
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


def _misses(report: Report) -> Iterator[str | Grid]:
    misses = report["misses"]
    if not misses:
        return
    late, skipped = counted(misses)
    yield from (
        "",
        f"## Missed and skipped cycles: {late} and {skipped}{_first(misses, 'first')}",
        "",
    )
    if (late, skipped) != (report["missed"], report["skipped"]):
        of_all = f"{report['missed']} and {report['skipped']}"
        why = (
            "the recorder lost rows"
            if report["rows_lost"]
            else "the recording does not hold all of it"
        )
        yield from (f"The tasks counted {of_all}; {why}.", "")
    rows = [
        [
            str(miss["tick"]),
            miss["task"],
            miss["what"] if miss["what"] == "late" else f"{miss['count']} skipped",
            *(decimal(miss.get(key)) for key in ("started_ms", "took_ms")),
        ]
        for miss in misses[:SHOWN]
    ]
    yield Grid(("tick", "task", "what", "started late, ms", "took, ms"), rows)


def _task(task: Report | None) -> Iterator[str]:
    if task is not None:
        done = (
            f"{task['action']} of {task['actions']} actions, {task['moves_done']} of"
            f" {task['moves']} elemental moves"
        )
        yield from (
            "",
            f"Task {task['state']}: {done}{'; ' + task['reason'] if task['reason'] else ''}.",
        )


def _objects(objects: Sequence[Report]) -> Iterator[str]:
    """Yield how far each object ended from its goal, and its falls."""
    for entry in objects:
        off = f"{entry['off_mm']:.1f} mm from its goal (tolerance {entry['tolerance_mm']:g} mm)"
        yield f"Object {entry['object']} ended {off}."
        for drop in entry.get("drops", ()):
            yield (
                f"Object {entry['object']} was let go {drop['mm']:.0f} mm above what it landed on, "
                f"at tick {drop['tick']}."
            )


def _motion(motion: Report | None) -> Iterator[str]:
    if motion is not None:
        yield (
            f"Tracking error {motion['tracking_rms_mrad']:.3f} mrad RMS,"
            f" {motion['tracking_peak_mrad']:.3f} peak; {motion['touches']} touches,"
            f" {motion['clipped_cycles']} cycles clipped; limits exceeded in {motion['violations']}"
            f" substeps, by a push from outside in {motion['pushed']}."
        )


def _hand(hand: Report | None) -> Iterator[str | Grid]:
    if hand is None:
        return
    yield (
        f"Tensions {hand['tension_rms_n']:.2f} N RMS off their commands,"
        f" {hand['tension_peak_n']:.2f} peak; {hand['least_tension_n']:.2f} to"
        f" {hand['largest_tension_n']:.2f} N; valves closed in {hand['closed_cycles']} cycles;"
        f" {hand['touches']} touches, {hand['clipped_cycles']} cycles clipped; limits exceeded in"
        f" {hand['violations']} substeps, by a push from outside in {hand['pushed']}."
    )
    forces = ", ".join(f"{finger} {force:.2f}" for finger, force in hand["largest_force_n"].items())
    yield f"Largest force on each tip, N: {forces}."


def _force(force: Report | None) -> Iterator[str]:
    if force is None:
        return
    off = (
        ""
        if force["force_rms_n"] is None
        else f"; axes of force {force['force_rms_n']:.2f} N RMS off"
    )
    yield (
        f"Contact: at most {force['largest_force_n']:.1f} N and {force['largest_torque_nm']:.2f} N"
        f" m, beyond the arm's limits in {force['exceeded_cycles']} cycles{off}."
    )


def _queues(queues: Sequence[Report]) -> Iterator[str]:
    for queue in queues:
        refused = f", {queue['refused']} refused" if queue["refused"] else ""
        yield (
            f"Queue {queue['mailbox']}: {queue['sent']} messages, {queue['taken']} of them read, at"
            f" most {queue['waiting']} waiting, room for {queue['capacity']}{refused}."
        )


def _interrupts(boards: Sequence[Report]) -> Iterator[str]:
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


def _times_row(name: str, task: Report) -> dict[str, str]:
    row = {"task": name, "R": f"{task['slice_ms']:g}"}
    row |= {key: str(task.get(key, "-")) for key in ("cycles", "missed", "skipped")}
    for title, key in (("late", "lateness_ms"), ("exec", "execution_ms")):
        row |= {f"{title} {part}": figure(task[key], part) for part in ("p50", "p99", "max")}
    row |= {key: decimal(task[f"{key}_ms"]) for key in ("deviation", "alpha")}
    row |= {
        "comm p99": figure(task["communication_ms"], "p99"),
        "proc p99": figure(task["processor_ms"], "p99"),
    }
    row |= {
        "residual min": figure(task["residual_ms"], "min"),
        "plan age max": figure(task.get("plan_age_ms"), "max"),
    }
    return row


def _response(response: Report | None) -> Iterator[str | Grid]:
    if response is None:
        return
    yield from ("", "## System response, ms of simulated time")
    for found in (response, *response["others"]):
        yield from _response_along(found)


def _response_along(response: Report) -> Iterator[str | Grid]:
    yield ""
    bounds = (
        f"eq. 3.2 bound {response['bound_eq_3_2_ms']:g}, eq. 3.3 sum {response['sum_eq_3_3_ms']:g}"
    )
    yield (
        f"{' > '.join(response['levels'])}: {bounds}; on a fixed grid each level also waits for its"
        " cycle."
    )
    yield ""
    ways = {"command, down": response["command"], "status, up": response["status"]}
    rows = [
        [
            (
                way
                if len(found["levels"]) == len(response["levels"])
                else f"{way} from {found['levels'][0]}"
            ),
            *(figure(found["measured_ms"], key) for key in ("p50", "max")),
            f"{found['bound_ms']:g}",
            JUDGED[found["holds"]],
        ]
        for way, found in ways.items()
        if found["levels"]
    ]
    yield Grid(("way", "measured p50", "measured max", "bound", ""), rows)
    for way, found in ways.items():
        if found["beyond"]:
            yield from (
                "",
                (
                    f"{way}: {len(found['beyond'])} beyond the"
                    f" bound{_first(found['beyond'], 'longest')}:"
                ),
            )
        for each in sorted(found["beyond"], key=lambda each: -each["ms"])[:SHOWN]:
            why = "; ".join(each["delayed_by"]) or "no cause is recorded"
            yield f"- {each['ms']:g} ms from tick {each['tick']}: {why}"
        if found["unseen"]:
            yield from (
                "",
                f"{way}: {found['unseen']} not measured: messages are missing in the recording.",
            )


def _entries(entries: list[Report]) -> Iterator[str | Grid]:
    """Yield what passed between the two sides; nothing for a rack without bus adapters."""
    if not entries:
        return
    yield from ("", "## Bus adapters, ages in ms of simulated time", "")
    yield _passed(entries, ("superseded", "waiting", "source"))


def _passed(rows: Sequence[Report], dropped: Sequence[str]) -> Grid:
    """Return what passed from side to side, and its ages."""
    counts = [name for name in rows[0] if name != "age_ms"]
    ages = ("p50", "p99", "max")
    cells = [
        [*(str(row[name]) for name in counts), *(figure(row["age_ms"], key) for key in ages)]
        for row in rows
    ]
    return Grid([*counts, *(f"age {key}" for key in ages)], cells, dropped)


def _network(network: Report | None) -> Iterator[str | Grid]:
    """Yield what passed over the network, and how often other racks were lost; nothing without a
    network adapter."""
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
