"""Tests queues in `rack status`, in the report of a run, and in `rack check`."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards import Rack
from rack.boards.config import load, resolve_layout
from rack.tools.console.tables import render_text
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.monitor.newest_messages import NewestMessages
from rack.tools.monitor.queues import list_queue_fills
from rack.tools.report.report import write_report
from rack.tools.timing.inventory import build_inventory, format_inventory
from tests.boards.test_queues import QUEUES

FULL = ("protocol.depth={ 'upper.requests' = 7 }", "board.lower.params.most=2")


@pytest.mark.slow
def test_status_check_and_report_show_fill_and_refusals_of_a_queue(
    tmp_path: Path, rack_name: str
) -> None:
    path = tmp_path / "queues.toml"
    path.write_text(QUEUES)
    config = load(path, [f"name={rack_name}", *FULL])
    (line,) = (
        line
        for line in render_text(
            format_inventory(build_inventory(config, resolve_layout(config), []))
        )
        if "upper.requests " in line
    )
    assert " queue 7 upper lower " in " ".join(line.split())
    with Rack(config) as rack:
        (empty,) = list_queue_fills(NewestMessages(rack.segment))
        assert empty.line == "queue upper.requests: 0 of 7 unread"
        rack.run(1.0)
        (full,) = list_queue_fills(NewestMessages(rack.segment))
    assert full.line == "queue upper.requests: 5 of 7 unread, 19 refused"
    result = run_rack(config, 2.0, tmp_path / "run", Display())
    report, text = write_report(tmp_path / "run")
    (queue,) = report["queues"]
    # Three requests every 40 ticks; two are taken every 100, first when six are visible.
    assert queue["sent"] + queue["refused"] == 3 * 20
    assert (queue["taken"], queue["waiting"], queue["capacity"]) == (2 * 7, 6, 7)
    assert result.refused == {"upper.requests": queue["refused"]}
    assert "## Queues: 1" in text.splitlines()
