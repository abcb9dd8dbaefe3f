"""Facts about a run as rows of clauses, for the summary and for report.md."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from rack.boards.events import Braking, format_brakings
from rack.tools.console.answer import Document
from rack.tools.recording.recording import Gap
from rack.tools.report.run_report import RunReport

Row = tuple[str, Iterable[str]]
"""A label, and clauses about its subject."""
LONG_HOLD_S = 0.5
"""Shortest hold of a level's own that is a fact. Every hold of an operator is one."""
COUNT_TEXTS = {
    "touches": "{touches} unintended contacts",
    "violations": "limits exceeded in {violations} substeps",
    "pushed": "pushed beyond them in {pushed}",
    "clipped_cycles": "commands refused or cut in {clipped_cycles} cycles",
}
OUTCOME_TEXTS = {
    "task": {
        "state": "{state}, {action} of {actions} actions, {moves_done} of {moves} moves",
        "reason": "{reason}",
    },
    "objects": {
        "object": "{at_goal} at goal, worst {object} {off_mm:.1f} mm ({tolerance_mm:g} mm)"
    },
    "motion": {
        "tracking_peak_mrad": (
            "tracking {tracking_rms_mrad:.2g} mrad RMS, {tracking_peak_mrad:.2g} peak"
        ),
        **COUNT_TEXTS,
    },
    "hand": {
        "tension_peak_n": "tension error {tension_rms_n:.2f} N RMS, {tension_peak_n:.2f} peak",
        "largest_tension_n": "tensions {least_tension_n:.2f} to {largest_tension_n:.2f} N",
        **COUNT_TEXTS,
        "closed_cycles": "valves closed in {closed_cycles} cycles",
        "forces": "largest forces on the tips {forces} N",
    },
    "force": {
        "largest_force_n": "at most {largest_force_n:.1f} N, {largest_torque_nm:.2f} N m",
        "exceeded_cycles": "above the limits in {exceeded_cycles} cycles",
        "force_rms_n": "error {force_rms_n:.2f} N RMS",
    },
}
"""Clauses about each part of the outcome. A clause is left out if the value of its key is 0."""


def list_reasons(report: RunReport) -> Iterator[Row]:
    """Yield why a run failed, and what its verdict does not cover."""
    yield from (("because", [why.removeprefix("stopped: ")]) for why in report.failures)
    yield from (("unjudged", [line]) for line in report.unjudged)
    if not any(report.recording in why for why in report.failures):
        yield "recording", [report.recording] * (report.recording not in ("complete", "none"))
        lost = (report.rows_lost or {}).items()
        gaps = [str(Gap(**gap)) for gap in report.gaps or () if lost]
        yield "recording", [f"{count:,} rows of {name} lost" for name, count in lost] + gaps
    yield "recording", [report.kept or ""]


def list_facts(report: RunReport) -> Iterator[Row]:
    """Yield what happened in a run, the most important subjects first."""
    outcome = report.outcome or {"reason": "", "brakings": ()}
    # A failure or the task's status may contain the reason already.
    is_said = report.task or any(outcome["reason"] in why for why in report.failures)
    yield "result", [] if is_said else [outcome["reason"]]
    yield from _list_outcome(report)
    brakings = [Braking(**braking) for braking in outcome["brakings"]]
    yield "brakes", [format_brakings(brakings).removeprefix("brakes ")] if brakings else []
    yield "standbys", [_format_active_copy(**copy) for copy in report.standbys or ()]
    if report.faults is not None:
        yield "faults", _list_fault_clauses(report.faults, report.unexplained)
    holds = [
        hold
        for hold in report.holds or ()
        if hold["lasted_s"] >= LONG_HOLD_S or hold["by"] == "operator"
    ]
    if holds:
        longest = max(holds, key=lambda hold: hold["lasted_s"])
        span = f"{longest['level']} for {longest['lasted_s']:g} s from {longest['since_s']:g} s"
        yield "holds", [f"{len(holds)}, longest {span}: {longest['why']}"]
    yield "restarts", [f"{task} {count}" for task, count in (report.restarts or {}).items()]
    for end in report.others:
        yield "rack", [f"{end['rack']}: {end['cause']} after {end['ticks']} ticks, {end['folder']}"]
    if origin := report.continues:
        yield "continues", [f"{origin['folder']} from {origin['time_s']:g} s"]
    yield "notes", report.notes or ()


def _list_outcome(report: RunReport) -> Iterator[Row]:
    """Yield clauses about the task and its objects, and about the arm or hand."""
    names = ("task", "motion", "hand", "force")
    values: dict[str, Document] = {name: {**(getattr(report, name) or {})} for name in names}
    if ends := report.objects:
        worst = max(ends, key=lambda end: end["off_mm"] - end["tolerance_mm"])
        at_goal = sum(end["off_mm"] <= end["tolerance_mm"] for end in ends)
        values["objects"] = worst | {"at_goal": f"{at_goal} of {len(ends)}"}
    if hand := values["hand"]:
        forces = hand["largest_force_n"].items()
        hand["forces"] = ", ".join(f"{finger} {force:.2f}" for finger, force in forces)
    for name, texts in OUTCOME_TEXTS.items():
        found = values.get(name, {})
        clauses = [text.format(**found) for key, text in texts.items() if found.get(key)]
        if "touches" in found and not any(found[key] for key in COUNT_TEXTS):
            clauses.append("no contact, no limit reached")
        yield name, clauses


def _format_active_copy(
    active: str, since_tick: int, since_s: float, why: str, hand_overs: int, **_: object
) -> str:
    """Format an entry of `RunReport.standbys` as a clause."""
    if not hand_overs:
        return f"{active} active throughout"
    times = f", after {hand_overs} hand-overs" if hand_overs > 1 else ""
    return f"{active} active since {since_s:g} s (tick {since_tick}){times}: {why}"


def _list_fault_clauses(
    faults: Sequence[Document], unexplained: Sequence[Document]
) -> Iterator[str]:
    """Yield clauses about injected faults, and about detections without a fault."""
    struck = [fault for fault in faults if fault["seen"] != "not struck"]
    bad = [f for f in struck if not (f["is_recovered"] and (f["is_within"] or not f["is_judged"]))]
    if faults:
        good = sum(fault["is_recovered"] and fault["is_within"] for fault in struck)
        yield f"{len(struck)} of {len(faults)} acted"
        yield f"{good} detected within bounds and recovered from"
    if bad:
        first = f"{bad[0]['kind']} of {bad[0]['board']} at tick {bad[0]['struck']}"
        yield f"{len(bad)} not, first {first}"
    if unexplained:
        yield f"detections without a fault: {len(unexplained)}, first: {unexplained[0]['text']}"
    if not (faults or unexplained):
        yield "none"
