"""What became of the faults of a run: struck, found by whom and how soon, reacted to, recovered from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout
from rack.boards.events import Event
from rack.tools.campaign.ending import Strike
from rack.tools.campaign.judge import Circumstances, Judgement, judge
from rack.tools.runs.recording import Recording

Report = dict[str, Any]


def faults(recording: Recording, layout: Layout) -> Report:
    """Return every fault injected into a run, detections that none explains, and restarts by task."""
    events = [Event(**event) for event in recording.events if "tick" in event]
    ended = next((event for event in recording.events if event["kind"] == "outcome"), {})
    strikes = [_strike(entry) for entry in ended.get("faults", [])]
    is_lockstep = any(event.kind == "start" and event.text == "lockstep" for event in events)
    verdict = judge(strikes, events, Circumstances(layout, ended.get("clock_offset_ns", 0), is_lockstep))
    restarts = Counter(event.board for event in events if event.code == "restart")
    return {
        # Those that never struck come last.
        "faults": [_row(found, layout) for found in sorted(verdict.faults, key=lambda f: (f.struck < 0, f.struck))],
        "unexplained": [_told(event) for event in verdict.unexplained],
        "restarts": dict(restarts),
    }


def _strike(entry: Mapping[str, Any]) -> Strike:
    injection = {**entry["injection"], "parameters": tuple(entry["injection"]["parameters"]), "when": None}
    return Strike(**{**entry, "mailboxes": tuple(entry["mailboxes"]), "injection": Injection(**injection)})


def _row(found: Judgement, layout: Layout) -> Report:
    tick_ms, cycle = layout.clock_ns * 1e-6, found.cycle
    return {
        **asdict(found),
        "reactions": list(found.reactions),
        "lacking": list(found.lacking),
        "delay_cycles": None if found.delay is None else round(found.delay / cycle, 3),
        "bound_cycles": None if found.bound is None else round(found.bound / cycle, 3),
        "recovery_ms": None if found.recovery is None else round(found.recovery * tick_ms, 6),
    }


def _told(event: Event) -> Report:
    return {"tick": event.tick, "board": event.board, "code": event.code or event.kind, "text": event.text}
