"""Tests that the event log of a run is complete at every moment, and sorted by ticks at the end."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rack.boards.events import Event
from rack.tools.launch.folder import EventLog
from rack.tools.monitor.display import Display

KNOWN = (("launch", -1), ("died", 2800), ("rejoined", 3000), ("brakes", 2801), ("opened", 3000))
"""Codes and ticks, as they become known."""


def codes(path: Path) -> list[str]:
    """Return the codes of the events in a log."""
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    return [entry.get("code", entry["kind"]) for entry in entries]


@pytest.mark.parametrize("is_ended", [True, False])
def test_a_log_is_sorted_by_tick_at_the_end(tmp_path: Path, is_ended: bool) -> None:
    path = tmp_path / "events.jsonl"
    log = EventLog(Display())
    log.open_file(path)
    for code, tick in KNOWN:
        log.add_event(Event(0, tick, "detection", "", "", code))
    assert codes(path) == [code for code, _ in KNOWN]
    if is_ended:
        log.write_outcome({"rack": "nasrem"})
        assert codes(path) == ["launch", "died", "brakes", "rejoined", "opened", "outcome"]
        assert [*tmp_path.iterdir()] == [path]
    else:
        log.close()
        assert codes(path) == [code for code, _ in KNOWN]
