"""A report as text for people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

Report = dict[str, Any]

SHOWN = 10
"""Misses that the text shows; report.json has them all."""

FAULTS = ["fault", "target", "at tick", "found as", "after", "bound", "reactions", "recovered after"]
TIMES = [
    *("task", "R", "cycles", "missed", "skipped", "late p50", "p99", "max", "exec p50", "p99", "max"),
    *("comm p99", "proc p99", "residual min", "deviation", "alpha", "plan age max"),
]


def markdown(report: Report) -> str:
    """Return report.md of a report."""
    return "\n".join(_lines(report)) + "\n"


def _lines(report: Report) -> Iterator[str]:
    outcome = report["outcome"] or {"cause": "no outcome recorded", "reason": "", "faults": []}
    yield f"# {report['rack']}: {outcome['cause']}{': ' + outcome['reason'] if outcome['reason'] else ''}"
    yield ""
    yield (
        f"{report['simulated_s']:.2f} s simulated in {report['wall_s']:.2f} s, {report['mode']}, "
        f"{report['missed']} missed, {report['skipped']} skipped cycles."
        f"{' Digest `' + report['digest'] + '`.' if report['digest'] else ''}"
    )
    yield from (f"- fault: {fault}" for fault in outcome["faults"])
    yield from (f"- {note}" for note in report["notes"])
    yield from _steal(report["steal"])
    if report["recording"] != "complete":
        yield f"- recording: {report['recording']}"
    yield from (f"- {count} rows of {name} were lost" for name, count in report["rows_lost"].items())
    yield from _against(report.get("against"))
    yield from _task(report["task"])
    yield from _motion(report["motion"])
    yield from ("", "## Cycles, ms", "")
    if report["mode"] == "lockstep":
        yield from ("In lockstep there are no deadlines: a tick lasts as long as its tasks take.", "")
    yield from _table(TIMES, [_times_row(name, task) for name, task in report["tasks"].items()])
    yield from _faults(report)
    yield from _misses(report["misses"])
    yield from _response(report["system_response"])


def _steal(steal: Report) -> Iterator[str]:
    """Say which misses are not the rack's own."""
    if steal["ms"]:
        cores = ", ".join(f"core {core} {ms} ms" for core, ms in steal["ms"].items())
        yield (
            f"- {steal['missed_during']} of {steal['missed']} misses while the hypervisor had the core; stolen: {cores}"
        )


def _against(against: Report | None) -> Iterator[str]:
    if against is None:
        return
    parting = against["first_difference"]
    if parting is None:
        yield f"- all messages are those of {against['folder']}"
        return
    missed = against["first_miss_tick"]
    why = f"the first miss is at tick {missed}" if missed is not None else "neither run has a miss"
    yield f"- parts from {against['folder']} at tick {parting['tick']}, in {parting['mailbox']}; {why}"


def _faults(report: Report) -> Iterator[str]:
    faults, unexplained, restarts = report["faults"], report["unexplained"], report["restarts"]
    if faults:
        yield from ("", f"## Faults: {len(faults)}", "")
        yield from _table(FAULTS, [_fault_row(fault) for fault in faults])
    if restarts:
        yield from ("", f"Restarts: {', '.join(f'{task} {count}' for task, count in restarts.items())}.")
    if unexplained:
        yield from ("", f"## Detections that no fault of this run explains: {len(unexplained)}", "")
        rows = [[str(found["tick"]), found["board"], found["code"], found["text"]] for found in unexplained]
        yield from _table(["tick", "found by", "as", "what"], rows)


def _fault_row(fault: Report) -> list[str]:
    subject = fault["mailbox"] or fault["joint"]
    is_struck = fault["seen"] != "not struck"
    found = f"{fault['found_as']} by {fault['found_by']}" if fault["seen"] == "detected" else fault["seen"]
    in_ms = fault["bound_ms"] is not None
    unit, after, bound = ("ms", "delay_ms", "bound_ms") if in_ms else ("cycles", "delay_cycles", "bound_cycles")
    return [
        fault["kind"],
        f"{fault['board']} {subject}".strip(),
        str(fault["struck"]) if is_struck else "-",
        found,
        *("-" if fault[key] is None else f"{fault[key]:.3g} {unit}" for key in (after, bound)),
        ", ".join(fault["reactions"]) or "-",
        "-" if fault["recovery_ms"] is None else f"{fault['recovery_ms']:.1f} ms",
    ]


def _misses(misses: list[Report]) -> Iterator[str]:
    if not misses:
        return
    yield from ("", f"## Misses: {len(misses)}, the first {min(SHOWN, len(misses))}", "")
    rows = [
        [str(miss["tick"]), miss["task"], miss["what"], *(_given(miss, key) for key in ("started_ms", "took_ms"))]
        for miss in misses[:SHOWN]
    ]
    yield from _table(["tick", "task", "what", "started late, ms", "took, ms"], rows)


def _given(miss: Report, key: str) -> str:
    return f"{miss[key]:.3f}" if key in miss else "-"


def _task(task: Report | None) -> Iterator[str]:
    if task is not None:
        done = f"{task['action']} of {task['actions']} actions, {task['moves_done']} of {task['moves']} elemental moves"
        yield from ("", f"Task {task['state']}: {done}{'; ' + task['reason'] if task['reason'] else ''}.")


def _motion(motion: Report | None) -> Iterator[str]:
    if motion is not None:
        yield (
            f"Tracking error {motion['tracking_rms_mrad']:.3f} mrad RMS, {motion['tracking_peak_mrad']:.3f} peak; "
            f"{motion['touches']} touches, {motion['clipped_cycles']} cycles clipped."
        )


def _times_row(name: str, task: Report) -> list[str]:
    counts = [str(task.get(key, "-")) for key in ("cycles", "missed", "skipped")]
    late, execution = task["lateness_ms"], task["execution_ms"]
    return [
        name,
        f"{task['slice_ms']:g}",
        *counts,
        *(_ms(late, key) for key in ("p50", "p99", "max")),
        *(_ms(execution, key) for key in ("p50", "p99", "max")),
        _ms(task["communication_ms"], "p99"),
        _ms(task["processor_ms"], "p99"),
        _ms(task["residual_ms"], "min"),
        *("-" if task[key] is None else f"{task[key]:.3f}" for key in ("deviation_ms", "alpha_ms")),
        _ms(task.get("plan_age_ms"), "max"),
    ]


def _ms(distribution: Report | None, key: str) -> str:
    return "-" if distribution is None else f"{distribution[key]:.3f}"


def _response(response: Report | None) -> Iterator[str]:
    if response is None:
        return
    yield from ("", "## System response, ms of simulated time", "")
    bounds = f"eq. 3.2 bound {response['bound_eq_3_2_ms']:g}, eq. 3.3 sum {response['sum_eq_3_3_ms']:g}"
    yield f"{' > '.join(response['levels'])}: {bounds}; on a fixed grid each level also waits for its cycle."
    yield ""
    rows = [
        [way, _ms(found["measured_ms"], "p50"), _ms(found["measured_ms"], "max"), f"{found['bound_ms']:g}"]
        for way, found in (("command, down", response["command"]), ("status, up", response["status"]))
    ]
    yield from _table(["way", "measured p50", "measured max", "bound"], rows)


def _table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    yield _row(head, widths)
    yield "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    yield from (_row(row, widths) for row in rows)


def _row(cells: list[str], widths: list[int]) -> str:
    return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"
