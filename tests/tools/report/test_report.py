"""Reports contain the figures of a run, computed from its recording alone."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from rich.console import Console

from rack.backplane.layout import TaskSpec
from rack.backplane.trace import RECORD
from rack.boards.config import load
from rack.levels.systems.force.messages import ForceStatus, Wrench
from rack.levels.systems.hand.messages import HandStatus
from rack.levels.systems.joint_boards.messages import DRIVING
from rack.tools.console.tables import print_blocks
from rack.tools.launch.launch import run_rack
from rack.tools.launch.verdict import ACROSS_RACKS, build_verdict
from rack.tools.monitor.display import Display
from rack.tools.recording.recording import Recording
from rack.tools.report import arm_outcome
from rack.tools.report.report import build_report, write_report
from rack.tools.report.report_markdown import format_markdown, format_report
from rack.tools.report.task_times import compute_task_times
from rack.tools.timing.measured_response import measure_system_response
from tests.boards.commanded_racks import commands
from tests.shared_runs import slow_run
from tests.tools.recordings import MS, Cycle


def test_the_messages_of_other_systems_have_the_names_that_the_report_looks_for() -> None:
    assert arm_outcome.DRIVING == DRIVING
    for kind in (ForceStatus, Wrench, HandStatus):
        assert getattr(arm_outcome, kind.message_type.name.upper()) == kind.message_type.name


def test_times_of_a_task_follow_equation_3_5() -> None:
    parts = [(0, 0.5, 3, 0.5), (0, 1, 4, 1), (0, 0.5, 2, 0.5)]
    late_ms = (1, 2, 0)
    rows = [Cycle(tick, parts[tick], late_ms[tick]).row(10 * MS) for tick in range(3)]
    task = TaskSpec("servo", "servo", "executor", 2, 0, 0, 1, 1, 64)
    cycles = np.array(rows, RECORD)
    times = compute_task_times(task, cycles, 10 * MS, True, stretches=np.zeros(3), due_ns=10 * MS)
    assert (times["lateness_ms"]["max"], times["lateness_ms"]["p50"]) == (2.0, 1.0)
    assert (times["execution_ms"]["min"], times["execution_ms"]["max"]) == (2.0, 4.0)
    assert times["communication_ms"]["max"] == 2.0
    # 10 ms less lateness, execution and communication: the worst cycle is the second.
    assert times["residual_ms"]["min"] == 2.0
    assert times["largest_gap_ms"] == 11.0
    assert times["alpha_ms"] == 4.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lockstep run of two levels with periods of 40 and 5 ticks."""
    return slow_run(tmp_path_factory)


@pytest.mark.slow
def test_measured_response_of_a_run_meets_its_prediction(folder: Path) -> None:
    report, text = write_report(folder)
    response = report["system_response"]
    assert response["levels"] == ["upper", "lower"]
    # 40 and 5 ticks: a command takes both cycles, a status waits for up to 35 ticks more.
    assert response["command"]["bound_ms"] == 45 * 2.5
    assert response["command"]["measured_ms"]["max"] == 45 * 2.5
    assert response["status"]["bound_ms"] == 80 * 2.5
    assert response["status"]["measured_ms"]["max"] == 80 * 2.5
    assert [response[way]["holds"] for way in ("command", "status")] == [True, True]
    assert report["digest"] in text
    assert report["tasks"]["lower"]["cycles"] == 400
    assert json.loads((folder / "report.json").read_text()) == report


class CutRecording(Recording):
    """A recording without ten of the commands. `lost` says whether their loss is known."""

    lost_rows: ClassVar[dict[str, int]] = {"upper.command": 10}

    def read_signal(self, mailbox: str, field: str) -> np.ndarray:
        values = super().read_signal(mailbox, field)
        return np.delete(values, slice(20, 30), axis=0) if mailbox == "upper.command" else values


class SilentRecording(CutRecording):
    """A recording of a run in which these commands were never written."""

    lost_rows: ClassVar[dict[str, int]] = {}


@pytest.mark.slow
def test_a_response_is_not_measured_across_messages_that_the_recording_lacks(folder: Path) -> None:
    way = build_report(CutRecording(folder))["system_response"]["command"]
    assert (way["holds"], way["beyond"], way["unseen"]) == (True, [], 1)
    assert way["measured_ms"]["max"] == way["bound_ms"]


@pytest.mark.slow
def test_a_response_beyond_its_bound_fails_with_the_cause_of_the_delay(folder: Path) -> None:
    recording = SilentRecording(folder)
    mute = {"kind": "mute", "board": "upper", "began": 19 * 40, "ends": 30 * 40, "tick": 19 * 40}
    recording.end_counts["faults"] = [mute | {"fault": 0}]
    report = build_report(recording)
    # A fault explains it.
    assert report["worked"]
    response = report["system_response"]
    (beyond,) = response["command"]["beyond"]
    assert response["command"]["holds"] is False
    assert (beyond["tick"], beyond["ms"]) == (19 * 40, (45 + 10 * 40) * 2.5)
    assert beyond["delayed_by"] == ["fault: mute of upper"]
    lines = format_markdown(write_report(folder)[0] | {"system_response": response}).splitlines()
    found = [line for line in lines if line.startswith("| command, upper to lower ")]
    (row,) = (line for line in found if "760" in line)
    cells = [cell.strip() for cell in row.split("|")[2:5]]
    assert cells == ["760", "1112.5", "fault: mute of upper"]


class ForkedRecording(Recording):
    """A recording whose upper level also writes a mailbox `upper.hint`, a few messages less."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        boxes = self.layout.mailboxes
        command = self.layout.find_mailbox("upper.command")
        hint = replace(command, name="upper.hint")
        self.layout = replace(self.layout, mailboxes=(*boxes, hint))

    @property
    def mailboxes(self) -> list[str]:
        return [*super().mailboxes, "upper.hint"]

    def read_signal(self, mailbox: str, field: str) -> np.ndarray:
        if mailbox != "upper.hint":
            return super().read_signal(mailbox, field)
        return np.delete(super().read_signal("upper.command", field), slice(20, 30), axis=0)


@pytest.mark.slow
def test_every_path_between_two_boards_is_measured(folder: Path) -> None:
    response = measure_system_response(ForkedRecording(folder))
    assert response is not None
    assert response["command"]["measured_ms"]["max"] == (45 + 10 * 40) * 2.5
    assert [beyond["tick"] for beyond in response["command"]["beyond"]] == [19 * 40]


@pytest.mark.slow
def test_a_response_beyond_its_bound_fails_the_run_if_nothing_explains_it(folder: Path) -> None:
    sound = build_report(Recording(folder))
    assert (sound["worked"], sound["failures"], sound["unjudged"]) == (True, [], [])
    report = build_report(SilentRecording(folder))
    (failure,) = report["failures"]
    assert report["worked"] is False
    assert failure == (
        "the response of a command along upper > lower took up to 1112.5 ms; bound: 112.5 ms, 1"
        " times exceeded without a lost cycle"
    )
    assert format_markdown(report).splitlines()[0] == f"# {report['rack']} failed: {failure}"


@pytest.mark.slow
def test_the_response_of_a_rack_that_imports_messages_is_not_judged(folder: Path) -> None:
    response = build_report(SilentRecording(folder))["system_response"]
    assert response["crosses_racks"] is False
    ended = Recording(folder).end_counts
    judged = build_verdict(ended, response | {"crosses_racks": True})
    assert judged == {"worked": True, "failures": [], "unjudged": [ACROSS_RACKS]}


@pytest.mark.slow
def test_lockstep_reports_no_time_relative_to_the_clock(folder: Path) -> None:
    report, text = write_report(folder)
    for task in report["tasks"].values():
        times = ("lateness_ms", "residual_ms", "alpha_ms", "deviation_ms", "largest_gap_ms")
        assert {task[name] for name in times} == {None}
        assert task["execution_ms"]["max"] > 0
    assert "there are no deadlines" in text
    assert not {"late", "alpha", "residual min"} & set(text.replace("|", " ").split())
    realtime = format_markdown({**report, "mode": "realtime"})
    assert "| residual min |" in realtime


@pytest.mark.slow
def test_the_section_of_misses_explains_why_it_lists_fewer_than_the_headline(folder: Path) -> None:
    late = {"task": "lower", "tick": 5, "what": "late", "count": 1}
    late |= {"started_ms": 0.1, "took_ms": 3.0, "why": "own execution", "why_ms": 2.9}
    skipped = {"task": "lower", "tick": 10, "what": "skipped", "count": 3}
    skipped |= {"why": "not recorded", "why_ms": None}
    report = write_report(folder)[0] | {"misses": [late, skipped], "missed": 1, "skipped": 3}
    lines = format_markdown(report).splitlines()
    assert "## Missed and skipped cycles: 2" in lines
    rows = [line.split("|") for line in lines if line.startswith("| lower | ")]
    whys = [[cell.strip() for cell in row[-3:-1]] for row in rows]
    assert whys == [["own execution", "2.9"], ["not recorded", "-"]]
    assert "The tasks counted" not in format_markdown(report)
    fewer = format_markdown({**report, "missed": 2, "skipped": 7})
    explanation = "2 and 7 lost cycles; the recording does not contain all of them."
    assert f"The tasks counted {explanation}" in fewer
    lossy = format_markdown({**report, "rows_lost": {"lower": 4}})
    assert "- recording: 4 rows of lower lost" in lossy.splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("width", [80, 120])
def test_a_report_fits_the_width_of_the_terminal(folder: Path, width: int) -> None:
    report = {**write_report(folder)[0], "mode": "realtime"}
    long = dict.fromkeys(("min", "p50", "p99", "p99_9", "max"), 1234.567)
    task = {**report["tasks"]["lower"], "lateness_ms": long, "residual_ms": long}
    report["tasks"] = dict.fromkeys(("elemental_move.planner", "lower"), task)
    terminal = Console(width=width, record=True, file=io.StringIO(), force_terminal=True)
    print_blocks(format_report(report), terminal)
    lines = terminal.export_text().splitlines()
    assert max(map(len, lines)) <= width
    rows = [line.split() for line in lines if line.startswith("elemental_move.planner")]
    head = next(line for line in lines if line.startswith("task ") and "missed" in line)
    assert len(rows) == 1
    assert "residual min" in head
    assert lines[-1] == f"all columns: {folder}/report.md; all data: report.json" or width == 80
    assert max(map(len, format_markdown(report).splitlines())) > 120


@pytest.mark.slow
def test_a_report_shows_who_held_a_level_and_what_is_still_held(
    commanded: Path, rack_name: str, tmp_path: Path
) -> None:
    given = commands(
        "level='upper', what='hold', tick=101",
        "level='upper', what='resume', tick=203",
        "level='lower', what='hold', tick=301",
    )
    config = load(commanded, [f"name={rack_name}", given])
    display = Display()
    # Looks often, because a run in lockstep ends soon.
    display.period_s = 0.02
    run_rack(config, 20.0, tmp_path / "run", display)
    report, text = write_report(tmp_path / "run")
    keys = ("level", "by", "why", "since_s", "until_s", "lasted_s")
    assert [[hold[key] for key in keys] for hold in report["holds"]] == [
        ["upper", "operator", "hold", 0.26, 0.52, 0.26],
        ["lower", "operator", "hold", 0.755, None, 19.2425],
    ]
    assert "## Holds, longest first: 2" in text.splitlines()
    release = f"rack command {rack_name} lower resume"
    assert f"Still held at the end: lower; `{release}` releases it." in text.splitlines()
    events = Recording(tmp_path / "run").events
    (standstill,) = (one["text"] for one in events if one.get("code") == "standstill")
    assert standstill.startswith("nothing has moved for ")
    held = "lower held by the operator (hold), since 0.75 s"
    assert standstill.endswith(f": {held}; to release: {release}")


HELD = "nothing has moved for 30 s: elemental_move holds"
TOUCHED = "level 'servo': unintended contact: 'post' touches 'link4' at 3.125 s"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("outcome", "headline"),
    [
        ({"cause": "task failed", "reason": HELD, "faults": []}, f" failed: task failed: {HELD}"),
        ({"cause": "task done", "reason": "", "faults": [TOUCHED]}, f" failed: {TOUCHED}"),
        ({"cause": "task done", "reason": "all done", "faults": []}, ": task done: all done"),
    ],
)
def test_the_headline_names_the_end_of_the_run_and_latched_faults(
    folder: Path, outcome: dict[str, object], headline: str
) -> None:
    recording = Recording(folder)
    recording.end_counts["outcome"] |= outcome
    report = build_report(recording)
    assert report["worked"] is (not outcome["faults"] and outcome["cause"] == "task done")
    assert format_markdown(report).splitlines()[0] == f"# {report['rack']}{headline}"
