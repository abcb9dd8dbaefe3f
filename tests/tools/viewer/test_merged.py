"""Several racks in one recording for the viewer, on the time line of the first."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from rack.tools.launch.continued import RepeatedRun, load_branch_config
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.recording import Recording
from rack.tools.recording.time_line import align_racks
from rack.tools.viewer.merged import write_merged
from rack.tools.viewer.pictures import NoViewerError, draw_picture
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.sink import RackWriter, RunContext
from rack.tools.viewer.stream import Stream, Timelines, open_recording
from tests.boards.remembering_racks import REMEMBERING
from tests.shared_runs import run_text
from tests.tools.command_line import rack
from tests.tools.machines import CLOCK_NS, MS, TICKS, A, B, S, recorded


def read_contents(file: Path) -> dict[tuple[str, str], Any]:
    """Return the values of all components in a file by entity and component, sorted by tick."""
    found: dict[tuple[str, str], list[Any]] = {}
    for chunk in RrdReader(str(file)).stream().to_chunks():
        if chunk.entity_path.startswith("/__"):
            continue
        batch = chunk.to_record_batch()
        is_timed = "tick" in batch.schema.names
        ticks = batch.column("tick").to_pylist() if is_timed else [-1] * batch.num_rows
        for name in batch.schema.names:
            if ":" in name:
                rows = zip(ticks, map(repr, batch.column(name).to_pylist()), strict=True)
                found.setdefault((chunk.entity_path, name), []).extend(rows)
    return {key: sorted(rows) for key, rows in found.items()}


@pytest.mark.slow
def test_a_view_built_from_files_equals_the_recorders_view(
    nasrem: Recording, tmp_path: Path
) -> None:
    write_merged(align_racks([nasrem]), tmp_path / "again.rrd", lambda part: None)
    again, live = read_contents(tmp_path / "again.rrd"), read_contents(nasrem.folder / "run.rrd")
    assert again.keys() == live.keys()
    for key, rows in live.items():
        # Limits are written once per block, and the blocks differ.
        if not key[0].endswith("limits"):
            assert again[key] == rows, key


@pytest.mark.slow
@pytest.mark.parametrize("step", [1, -1])
def test_the_goal_of_a_move_does_not_depend_on_how_the_recorder_reads_rings(
    nasrem: Recording, tmp_path: Path, step: int
) -> None:
    names = sorted((*nasrem.mailboxes, *nasrem.cycles))[::step]
    rows = {name: nasrem.read_rows(name) for name in names}
    context = RunContext.from_config(nasrem.layout, nasrem.config, nasrem.folder)
    recording = open_recording("run", "run", tmp_path / "one.rrd", rrb.Blueprint())
    grid = align_racks([nasrem])[0].grid
    stream = Stream(recording, Timelines(grid.clock_ns, grid.launch))
    RackWriter(stream, context).write(rows, grid.ticks[1] + 1, {})
    recording.disconnect()
    goals = ("/cell/current_goal", "Points3D:labels")
    one, live = read_contents(tmp_path / "one.rrd"), read_contents(nasrem.folder / "run.rrd")
    assert one[goals] == live[goals]
    assert one[goals][-1][1] == "['move']"


@pytest.fixture(scope="module")
def merged_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("both")
    places = align_racks([recorded(A, [B], folder / "a"), recorded(B, [A], folder / "b")])
    shown: list[float] = []
    write_merged(places, folder / "both.rrd", shown.append)
    assert shown == sorted(shown)
    assert shown[-1] == 1.0
    return folder / "both.rrd"


def test_each_rack_is_below_its_name_and_simultaneous_events_coincide(merged_file: Path) -> None:
    entities = {
        path.split("/")[1] for path in RrdReader(str(merged_file)).store().schema().entity_paths()
    }
    assert {"a", "b"} <= {entity for entity in entities if not entity.startswith("__")}
    assert {entity for entity in entities if not entity.startswith("__")} <= {"a", "b", "log"}
    for machine in (A, B):
        lane = f"/{machine.rack}/boards/1-pulse/executor"
        chunks = RrdReader(str(merged_file)).stream().filter(content=lane).to_chunks()
        batches = [chunk.to_record_batch() for chunk in chunks if "tick" in chunk.timeline_names]
        times, ticks = (
            np.concatenate([batch.column(name).to_numpy() for batch in batches])[::4].astype(int)
            for name in ("sim_time", "tick")
        )
        true = [A.shows(machine.true_ns(tick)) - A.epoch_ns for tick in range(TICKS)]
        assert np.abs(np.sort(times) - true).max() < MS
        assert (ticks == times // CLOCK_NS).all()


def test_the_uncertainty_of_times_is_in_the_log(merged_file: Path) -> None:
    (line,) = (
        read_component(merged_file, "/log/time\\ line", "TextLog:text").values.ravel().tolist()
    )
    begin = (A.shows(B.begins_ns) - A.epoch_ns) / S
    text = f"rack 'b' is on the time line of 'a': it begins at +{begin:.3f}"
    assert line.partition(": ")[2].startswith(text)
    assert line.endswith(" ms")


@pytest.fixture(scope="module")
def branched_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of two runs: "run", and "other", which branches off at tick 150; and of the file
    in which both are, "both.rrd"."""
    run = run_text(tmp_path_factory, REMEMBERING, 0.75)
    folder, whole = run.parent, Recording(run)
    config = load_branch_config(whole, ["board.wave.params.factor=2"], None)
    with RepeatedRun(whole) as again:
        run_rack(config, 0.75, folder / "other", Display(), beginning=again.continue_at(150))
    names = ("other", "--against", "run", "--out", "both.rrd")
    done = rack("replay", *names, folder=folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.thorough
def test_a_branch_is_shown_on_the_ticks_of_its_run_with_the_fork_marked(
    branched_runs: Path,
) -> None:
    merged_file = branched_runs / "both.rrd"
    names = ("run", "other")
    curves = [read_component(merged_file, f"/{run}/signals/wave.status/value") for run in names]
    for rows, run in zip(curves, names, strict=True):
        own = Recording(branched_runs / run)
        assert rows.ticks.tolist() == own.read_signal("wave.status", "tick").tolist()
        assert rows.values.ravel().tolist() == own.read_signal("wave.status", "value").tolist()
    assert (curves[0].ticks[0], curves[1].ticks[0]) == (0, 150)
    marks = read_component(merged_file, "/log/time\\ line", "TextLog:text")
    assert list(zip(marks.ticks.tolist(), marks.values.ravel().tolist(), strict=True)) == [
        (150, "tick 150: other branches off"),
        (150, "tick 150: other differs from run: wave.status"),
    ]


@pytest.mark.thorough
@pytest.mark.parametrize("view", [None, "log of all runs"])
def test_no_view_of_a_branch_and_its_run_fails_in_the_viewer(
    branched_runs: Path, view: str | None
) -> None:
    try:
        picture = draw_picture([branched_runs / "both.rrd"], 0.5, view)
    except NoViewerError as error:
        pytest.skip(str(error))
    assert picture.complaints == []
