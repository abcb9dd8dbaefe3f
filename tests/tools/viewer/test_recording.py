"""The recording for the viewer, read back from a short run of the whole rack."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from rerun.chunk import RrdReader

from rack.boards.config import build_rack_timing, load, read_stored
from rack.boards.config.cell import build_rack_cell
from rack.levels.robot.engine import view_state
from rack.tools.recording.recording import Recording
from rack.tools.viewer.levels import name_lanes
from rack.tools.viewer.pictures import NoViewerError, draw_picture
from rack.tools.viewer.reading import read_component
from tests.shared_runs import NASREM_S

pytestmark = pytest.mark.slow


def test_joint_curves_are_the_signals_bit_for_bit(nasrem: Recording) -> None:
    ticks = nasrem.read_signal("servo.status", "tick")
    for at, joint in enumerate(load("nasrem").robot.joints):
        for quantity, fields in {"position": ["target", "position"], "torque": ["torque"]}.items():
            rows = read_component(nasrem.folder / "run.rrd", f"/joints/{joint}/{quantity}")
            assert np.array_equal(rows.ticks, ticks)
            expected = np.column_stack(
                [nasrem.read_signal("servo.status", field)[:, at] for field in fields]
            )
            assert np.array_equal(rows.values, expected)


def test_poses_are_mujocos_own(nasrem: Recording) -> None:
    cell = build_rack_cell(nasrem.rack_config)

    ticks, found = (nasrem.read_signal("servo.state", name) for name in ("tick", "state"))
    states = dict(zip(ticks.tolist(), found, strict=True))
    file, data = nasrem.folder / "run.rrd", mujoco.MjData(cell.model)
    frames = read_component(file, "/frames", "Transform3D:child_frame")
    places = read_component(file, "/frames", "Transform3D:translation").values[:, 0]
    turns = read_component(file, "/frames", "Transform3D:quaternion").values[:, 0]
    for tick in np.unique(frames.ticks)[::37]:
        view_state(cell.model, data, states[tick])
        mujoco.mj_kinematics(cell.model, data)
        for row in np.flatnonzero(frames.ticks == tick):
            body = data.body(frames.values[row, 0].removeprefix("body/"))
            assert places[row] == pytest.approx(body.xpos, abs=1e-6)
            assert turns[row][[3, 0, 1, 2]] == pytest.approx(body.xquat, abs=1e-6)
    assert {"body/link6", "body/finger_left", "body/block1", "body/peg"} <= set(frames.values[:, 0])


def test_each_cycle_of_each_task_has_its_spans(nasrem: Recording) -> None:
    names = name_lanes(nasrem.layout, build_rack_timing(read_stored(nasrem.config), nasrem.layout))
    assert list(names.values()) == [
        "1-task",
        "1-task.planner",
        "2-elemental_move",
        "2-elemental_move.planner",
        "3-primitive",
        "3-primitive.planner",
        "4-servo",
        "4-servo.planner",
        "5-world",
    ]
    for task in nasrem.layout.tasks:
        lane = f"/boards/{names[task.board]}/{task.role}"
        rows = read_component(nasrem.folder / "run.rrd", lane, "StateChange:state")
        cycles = nasrem.cycles[task.name]
        work = "process" if task.role == "executor" else "plan"
        assert np.array_equal(rows.ticks, np.repeat(cycles["tick"], 4))
        assert rows.values.ravel().tolist() == ["read", work, "write", "wait"] * len(cycles)


def test_an_age_belongs_to_the_newest_visible_message(nasrem: Recording) -> None:
    box = "elemental_move.status"
    made, visible = (nasrem.read_signal(box, name) for name in ("tick", "visible_at"))
    rows = read_component(nasrem.folder / "run.rrd", "/ages/elemental_move.status")
    expected = [
        (tick - made[visible <= tick].max()) * nasrem.layout.clock_ns * 1e-6 for tick in rows.ticks
    ]
    assert rows.values.ravel() == pytest.approx(expected)
    # The message is read immediately by a board of equal or lower rate, so its age is the sampling
    # delay of the paper.
    assert rows.values.min() == pytest.approx(250.0)


def test_the_recording_contains_config_and_events(nasrem: Recording) -> None:
    file = nasrem.folder / "run.rrd"
    document = (
        RrdReader(str(file)).stream().filter(content="/config").to_chunks()[0].to_record_batch()
    )
    assert nasrem.config in document.column("TextDocument:text")[0].as_py()[0]
    lines = read_component(file, "/log/events", "TextLog:text").values.ravel().tolist()
    shown = [e for e in nasrem.events if "tick" in e and (e["kind"], e["tick"]) != ("waiting", -1)]
    assert len(lines) == len(shown)
    assert sorted(line.split(": ")[1] for line in lines) == sorted(e["kind"] for e in shown)


def test_the_blueprint_shows_only_existing_entities(nasrem: Recording) -> None:
    reader = RrdReader(str(nasrem.folder / "run.rrd"))
    recorded = {path.replace("\\", "") for path in reader.store().schema().entity_paths()}
    chunks = reader.stream(store=reader.blueprints()[0]).to_chunks()
    queries = [
        line
        for chunk in chunks
        for name in chunk.to_record_batch().schema.names
        if name == "ViewContents:query"
        for row in chunk.to_record_batch().column(name).to_pylist()
        for line in row
    ]
    assert len(queries) > 40
    for query in queries:
        entity = query.replace("\\", "").removeprefix("+").strip()
        if not entity.startswith(("-", "/signals", "/events", "/levels/5-world")):
            stem = entity.removesuffix("/**").replace("$origin", "/")
            assert any(
                path == stem or path.startswith(stem.rstrip("/") + "/") for path in recorded
            ), query


def test_no_view_fails_in_the_viewer(nasrem: Recording) -> None:
    try:
        look = draw_picture([nasrem.folder / "run.rrd"], NASREM_S - 0.5)
    except NoViewerError as error:
        pytest.skip(str(error))
    assert look.complaints == []
    assert look.png.startswith(b"\x89PNG")
