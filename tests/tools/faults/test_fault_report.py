"""Faults in the report: from what a run recorded, and as text."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rack.boards.config import load
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.report.report import write_report
from rack.tools.report.report_markdown import format_markdown
from rack.tools.viewer.reading import read_component
from tests.shared_runs import faulty_run

pytestmark = pytest.mark.slow

Report = dict[str, Any]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return faulty_run(tmp_path_factory)


@pytest.fixture(scope="module")
def report(folder: Path) -> Report:
    return write_report(folder)[0]


def test_a_fault_is_reported_with_its_detection_reaction_and_recovery(
    folder: Path, report: Report
) -> None:
    hang, never = report["faults"]
    assert (hang["kind"], hang["board"], hang["struck"]) == ("hang", "upper", 80)
    assert (hang["seen"], hang["found_by"], hang["found_as"]) == ("detected", "clock", "hang")
    # Four releases of eight ticks unanswered.
    assert 0 < hang["delay_cycles"] <= hang["bound_cycles"] == 5
    assert hang["is_within"]
    assert hang["recovery_ms"] > 0
    assert report["restarts"] == {"upper": 1}
    assert (never["seen"], never["found_by"], never["delay_cycles"]) == ("not struck", "", None)
    assert report["unexplained"] == []
    assert write_report(folder)[0] == report
    assert json.loads((folder / "report.json").read_text()) == report


def test_the_text_has_a_row_for_each_fault(report: Report) -> None:
    lines = format_markdown(report).splitlines()
    head = lines.index("## Faults: 2")
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[head + 2 :]]
    first, second = (dict(zip(cells[0], row, strict=True)) for row in cells[2:4])
    assert [first[key] for key in ("kind", "board", "struck")] == ["hang", "upper", "80"]
    assert (first["found_as"], first["found_by"], first["bound_cycles"]) == ("hang", "clock", "5")
    assert (second["board"], second["seen"], second["found_as"]) == ("lower", "not struck", "-")
    assert "- restarts: upper 1" in lines
    found = {"tick": 7, "board": "upper", "code": "gap", "text": "a message is missing"}
    lines = format_markdown({**report, "unexplained": [found]}).splitlines()
    assert "## Detections without a fault: 1" in lines
    assert "| 7    | upper | gap  | a message is missing |" in lines
    plain = format_markdown({**report, "faults": [], "restarts": {}})
    assert not {"Faults", "restarts"} & set(plain.replace(":", " ").split())


def test_a_silent_board_is_recovered_from_only_when_it_is_heard_again(
    small: Path, tmp_path: Path, rack_name: str
) -> None:
    mute = 'kind = "mute", board = "lower"'
    faults = f'fault=[{{ {mute}, tick = 80, for = "50ms" }}, {{ {mute}, tick = 200 }}]'
    run_rack(load(small, [f"name={rack_name}", faults]), 1.0, tmp_path / "run", Display())
    report = write_report(tmp_path / "run")[0]
    found = [(fault["seen"], fault["found_as"]) for fault in report["faults"]]
    assert found == [("detected", "mute")] * 2
    assert [fault["is_recovered"] for fault in report["faults"]] == [True, False]
    rows = [line for line in format_markdown(report).splitlines() if line.startswith("| mute")]
    assert [row.strip("| ").rpartition(" ")[2] for row in rows] == ["True", "False"]


def test_the_viewer_shows_the_course_of_a_fault_in_the_lane_of_its_board(folder: Path) -> None:
    def shown(entity: str, component: str) -> list[str]:
        return list(read_component(folder / "run.rrd", entity, component).values.ravel())

    lane = shown("/events/1-upper", "StateChange:state")
    # The fault ends with its board's process; who hears of which first is open, and the reaction
    # stays in sight.
    assert [state for state in lane if state] == ["fault", "died", "reaction", "recovery"]
    assert "" not in lane[lane.index("died") :]
    text, levels = (shown("/log/events", f"TextLog:{part}") for part in ("text", "level"))
    level_of = {line.split(": ")[1]: level for line, level in zip(text, levels, strict=True)}
    found = [level_of[kind] for kind in ("fault", "detection", "recovery")]
    assert found == ["WARN", "ERROR", "INFO"]
