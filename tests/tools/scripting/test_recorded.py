"""Tests reading a run from a program: signals, tables, events and report."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import rack
from rack.boards import Rack
from rack.boards.config import load
from rack.tools.recording.recording import Recording
from tests.processes import BOUND_S
from tests.shared_runs import SMALL_S
from tests.tools.recordings import add_events

pytestmark = pytest.mark.slow


def test_a_signal_is_an_array_with_its_ticks_and_unit(nasrem: Recording) -> None:
    run = rack.open_run(nasrem.folder)
    position = run.signals["servo.status.position"]
    assert (position.unit, position.values.shape) == ("rad", (2600, 6))
    assert position.ticks.tolist() == list(range(2600))
    assert position.time_s[400] == 1.0
    third = run.signals["servo.status.position[2]"]
    np.testing.assert_array_equal(third.values, position.values[:, 2])
    assert "servo.status.position" in run.signals
    table = position.to_pandas()
    assert [*table.columns] == ["tick", *(f"servo.status.position[{i}]" for i in range(6))]
    assert table["servo.status.position[2]"].loc[1.0] == third.values[400]
    levels = run.to_pandas("task.status")
    assert set(levels["task.status.state"]) <= {"idle", "executing", "holding"}
    assert len(levels) == len(run.signals["task.status.state"].ticks)


def test_a_run_at_a_time_has_the_messages_that_tasks_read_then(run: Path) -> None:
    moment = rack.open_run(run).at(1.2)
    assert (moment.tick, moment.time_s) == (480, 1.2)
    status = rack.open_run(run).signals["lower.status.count"]
    # Written in the tick before, visible now.
    assert moment["lower.status.count"] == moment.read("lower.status").count
    assert moment["lower.status.count"] == status.values[status.ticks == 479]
    assert moment["upper.status.state"] == "idle"
    assert {"lower.status", "upper.command", "lower.plan"} <= set(moment.mailboxes)
    with pytest.raises(rack.Failure, match=r"no message yet at 0 s"):
        rack.open_run(run).at(0).read("lower.status")
    with pytest.raises(rack.Failure, match=r"^4\.1: must be 0 to 3\.9975 s$"):
        rack.open_run(run).at(4.1)


def test_a_run_is_resumed_from_a_time_in_the_background(run: Path) -> None:
    expected = Recording(run).end_counts["outcome"]
    with rack.open_run(run).at(1.2025).resume(seconds=SMALL_S) as resumed:
        outcome = resumed.wait(BOUND_S)
    assert outcome is not None
    assert (outcome.digest, outcome.ticks) == (expected["digest"], expected["ticks"])
    with pytest.raises(rack.Failure, match=r"board\.upper\.more = 1: unknown key"):
        rack.open_run(run).at(1.2025).resume("board.upper.more=1")


def test_events_and_report_are_those_of_the_run(run: Path) -> None:
    opened = rack.open_run(run)
    ends = [event.kind for event in opened.events if event.kind in ("start", "end")]
    assert ends == ["start", "end"]
    assert opened.report["simulated_s"] == 4.0
    assert (run / "report.json").is_file()


def test_runs_and_signals_describe_themselves(run: Path) -> None:
    opened = rack.open_run(run)
    name = opened._recording.layout.rack
    ends = f"time over, {len(opened.signals)} signals>"
    assert repr(opened) == f"<run {run} of rack '{name}': {ends}"
    count = opened.signals["lower.status.count"]
    assert repr(opened.signals).startswith(f"<{len(opened.signals)} signals of ")
    assert repr(opened.at(1.2)) == f"<run {run} at 1.2 s, tick 480>"
    spec = count.signal.spec
    assert (count.meaning, count.unit) == (spec.meaning, "")
    assert repr(count) == f"<signal lower.status.count: {spec.meaning}>"


def test_a_plot_has_units_names_and_marks(run: Path, tmp_path: Path) -> None:
    from matplotlib import pyplot

    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    add_events(
        folder,
        (400, "fault", "begins", "wave begins"),
        (800, "fault", "begins", "kill begins"),
        (800, "died", "died", "board 'lower' ended"),
        (900, "fault", "ends", "wave ends"),
    )
    signals = rack.open_run(folder).signals
    axes = signals["lower.status.count"].plot()
    (count,) = axes.get_lines()
    values = signals["lower.status.count"].values
    np.testing.assert_array_equal(count.get_ydata(), [*values, values[-1]])
    assert axes.get_xlabel() == "simulated time, s"
    assert axes.get_ylabel() == "lower.status.count"
    marks = {mark.get_label(): mark.get_paths() for mark in axes.collections}
    assert [(label, paths[0].vertices[0][0]) for label, paths in marks.items()] == [
        ("fault, 1 s: lower: wave begins", 1.0),
        ("fault, 2 s: lower: kill begins", 2.0),
        ("lost, 2 s: lower: board 'lower' ended", 2.0),
    ]
    state = signals["lower.status.state"].plot(pyplot.figure().add_subplot())
    assert "executing" in [label.get_text() for label in state.get_yticklabels()]
    pyplot.close("all")
    with pytest.raises(
        rack.Failure, match=r"^lower\.status\.reason: is a text; only numbers can be plotted"
    ):
        signals["lower.status.reason"].plot()


def test_a_plot_of_an_array_has_a_curve_a_number(nasrem: Recording) -> None:
    from matplotlib import pyplot

    axes = rack.open_run(nasrem.folder).signals["servo.status.position"].plot()
    assert [line.get_label() for line in axes.get_lines()] == [f"[{joint}]" for joint in range(6)]
    assert axes.get_ylabel() == "servo.status.position, rad"
    pyplot.close("all")


def test_without_a_package_one_line_says_what_to_install(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("pandas", "matplotlib"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(rack.Failure, match=r"^tables need pandas: pip install 'nasrem-rack\["):
        rack.open_run(run).to_pandas("lower.status")
    with pytest.raises(rack.Failure, match=r"^no pictures: they need matplotlib: pip install 'n"):
        rack.open_run(run).signals["lower.status.count"].plot()


def test_a_rack_of_a_program_is_recorded(commanded: Path, tmp_path: Path, rack_name: str) -> None:
    own = Rack(load(commanded, [f"name={rack_name}", "clock.mode=lockstep"]))
    with own, rack.attach(rack_name) as live:
        live.record(tmp_path / "run")
        own.run_in_background(1.0)
        outcome = own.wait(20)
        with pytest.raises(rack.Failure, match="exists already and is not an empty folder"):
            live.record(tmp_path / "run")
    assert outcome is not None
    run = rack.open_run(tmp_path / "run")
    assert run.signals["lower.status.count"].ticks.tolist() == list(range(400))
    assert Recording(tmp_path / "run").find_gaps() == []
    assert run.events == []
