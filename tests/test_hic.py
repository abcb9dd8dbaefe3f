"""The rack hic, with real processes in lockstep: events are served in the slack of its table, and
data ages are constant."""

from __future__ import annotations

import os

import numpy as np
import pytest

from rack.boards.config import build_rack_timing, load, resolve
from rack.boards.timing.frames import compute_core_frames
from rack.tools.recording.recording import Recording
from rack.tools.report.report import build_report, summarize_data_ages
from rack.tools.report.report_markdown import format_markdown
from tests.shared_runs import record

SECONDS = 3.0
FRAME = 4
"""Ticks of a minor frame."""
VARYING = {"world.scene", "events.events"}
"""Inputs whose data ages are no single value: images come at 62.5 Hz, events at any time."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Return a run in which the fingers close on the can."""
    folder = tmp_path_factory.mktemp("hic") / "run"
    config = load("hic", [f"name=test-hic-{os.getpid()}", "clock.mode=lockstep"])
    return record(config, SECONDS, folder)


@pytest.mark.thorough
def test_a_burst_of_events_is_served_one_in_a_frame_and_the_queue_keeps_the_rest(
    run: Recording,
) -> None:
    raised, ids = (run.read_signal("fingertip.events", name) for name in ("raised", "id"))
    tick, served, response, touching, contact = (
        run.read_signal("events.status", name)
        for name in ("tick", "served", "response", "touching", "contact")
    )
    rows = np.flatnonzero(np.diff(served, prepend=0))
    assert (np.diff(served)[rows[1:] - 1] == 1).all()
    assert (ids == np.arange(1, len(ids) + 1)).all()
    assert len(ids) >= 4
    # Several tips touch in one cycle of the fingertip loop, and wait for frames of their own.
    assert len(set(raised.tolist())) < len(raised)
    assert (tick[rows] - response[rows] == raised[: len(rows)]).all()
    assert (tick[rows] % FRAME == 0).all()
    # A cycle of the fingertip loop until the queue shows them, and the rest of a frame.
    assert set(response[rows].tolist()) <= {18 + FRAME * waiting for waiting in range(4)}
    assert touching[-1].all()
    # The can is a cylinder of 28 mm along the y axis of the palm, held from both sides.
    across = contact[-1][:, [0, 2]]
    centre = (across[:3].mean(axis=0) + across[3]) / 2.0
    assert np.linalg.norm(across - centre, axis=1) == pytest.approx(np.full(4, 0.028), abs=0.004)


@pytest.mark.thorough
def test_each_reader_takes_data_of_one_age_and_the_report_lists_it(run: Recording) -> None:
    ages = {row["entry"]: row for row in summarize_data_ages(run)}
    assert {name.partition(".")[0] for name in ages} == {
        *("hand", "tendon", "joint", "fingertip", "grasp", "world", "events")
    }
    assert {name for name, row in ages.items() if row["jitter"]} <= VARYING
    assert ages["world.scene"]["jitter"] > 0.0
    in_ms = {name: row["age_ms"]["max"] for name, row in ages.items()}
    assert in_ms["hand.tensions_tendon"] == in_ms["tendon.above"] == 0.5
    assert in_ms["joint.hand"] == 1.0
    text = format_markdown(build_report(run))
    assert "## Data ages of the boards' inputs: " in text
    assert "| hand.tensions_tendon " in text


def find_events_slack_ns(*settings: str) -> list[int]:
    """Return the slack of the event board in each kind of frame."""
    config = load("hic", settings)
    frames = compute_core_frames(build_rack_timing(config, resolve(config).layout))
    return [place.slack_ns for core in frames for place in core.places if place.board == "events"]


def test_events_fit_the_slack_of_every_frame_and_more_work_does_not() -> None:
    slack = find_events_slack_ns()
    assert len(slack) == 4
    assert min(slack) > 0
    assert min(find_events_slack_ns("board.events.budget.process_ms=0.4")) < 0
