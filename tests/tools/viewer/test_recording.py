"""The recording for the viewer, read back from a short run of the whole rack."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from rerun.chunk import RrdReader

from rack.boards.config import build_rack_timing, load, load_text, read_stored
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.robot.engine import view_state
from rack.tools.recording.recording import Recording
from rack.tools.viewer.levels import name_lanes
from rack.tools.viewer.pictures import NoViewerError, draw_picture
from rack.tools.viewer.reading import read_component
from tests.shared_runs import NASREM_S, nasrem_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return Recording(nasrem_run(tmp_path_factory))


@pytest.fixture(scope="module")
def cell(run: Recording) -> Cell:
    config = load_text(run.config)
    assert config.robot is not None
    return build_cell(config.robot, config.scene, config.clock_ns)


@pytest.mark.slow
def test_joint_curves_are_the_signals_bit_for_bit(run: Recording) -> None:
    ticks = run.read_signal("servo.status", "tick")
    for at, joint in enumerate(load("nasrem").robot.joints):
        for quantity, fields in {"position": ["target", "position"], "torque": ["torque"]}.items():
            rows = read_component(run.folder / "run.rrd", f"/joints/{joint}/{quantity}")
            assert np.array_equal(rows.ticks, ticks)
            expected = np.column_stack(
                [run.read_signal("servo.status", field)[:, at] for field in fields]
            )
            assert np.array_equal(rows.values, expected)


@pytest.mark.slow
def test_poses_are_mujocos_own(run: Recording, cell: Cell) -> None:
    states = dict(
        zip(
            run.read_signal("servo.state", "tick").tolist(),
            run.read_signal("servo.state", "state"),
            strict=True,
        )
    )
    file, data = run.folder / "run.rrd", mujoco.MjData(cell.model)
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


@pytest.mark.slow
def test_each_cycle_of_each_task_has_its_spans(run: Recording) -> None:
    names = name_lanes(run.layout, build_rack_timing(read_stored(run.config), run.layout))
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
    for task in run.layout.tasks:
        lane = f"/boards/{names[task.board]}/{task.role}"
        rows = read_component(run.folder / "run.rrd", lane, "StateChange:state")
        cycles = run.cycles[task.name]
        work = "process" if task.role == "executor" else "plan"
        assert np.array_equal(rows.ticks, np.repeat(cycles["tick"], 4))
        assert rows.values.ravel().tolist() == ["read", work, "write", "wait"] * len(cycles)


@pytest.mark.slow
def test_an_age_belongs_to_the_newest_visible_message(run: Recording) -> None:
    made, visible = (
        run.read_signal("elemental_move.status", "tick"),
        run.read_signal("elemental_move.status", "visible_at"),
    )
    rows = read_component(run.folder / "run.rrd", "/ages/elemental_move.status")
    expected = [
        (tick - made[visible <= tick].max()) * run.layout.clock_ns * 1e-6 for tick in rows.ticks
    ]
    assert rows.values.ravel() == pytest.approx(expected)
    # The message is read immediately by a board of equal or lower rate, so its age is the sampling
    # delay of the paper.
    assert rows.values.min() == pytest.approx(250.0)


@pytest.mark.slow
def test_the_recording_contains_config_and_events(run: Recording) -> None:
    file = run.folder / "run.rrd"
    document = (
        RrdReader(str(file)).stream().filter(content="/config").to_chunks()[0].to_record_batch()
    )
    assert run.config in document.column("TextDocument:text")[0].as_py()[0]
    lines = read_component(file, "/log/events", "TextLog:text").values.ravel().tolist()
    shown = [e for e in run.events if "tick" in e and (e["kind"], e["tick"]) != ("waiting", -1)]
    assert len(lines) == len(shown)
    assert sorted(line.split(": ")[1] for line in lines) == sorted(e["kind"] for e in shown)


@pytest.mark.slow
def test_the_blueprint_shows_only_existing_entities(run: Recording) -> None:
    reader = RrdReader(str(run.folder / "run.rrd"))
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


@pytest.mark.slow
def test_no_view_fails_in_the_viewer(run: Recording) -> None:
    try:
        look = draw_picture([run.folder / "run.rrd"], NASREM_S - 0.5)
    except NoViewerError as error:
        pytest.skip(str(error))
    assert look.complaints == []
    assert look.png.startswith(b"\x89PNG")
