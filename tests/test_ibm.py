"""The rack ibm, with real processes in lockstep: what brakes the arm on the way down is no touch,
and its blocks are wired anew while it runs."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rack.boards import Rack
from rack.boards.config import load
from rack.tools.commands.status import status
from rack.tools.console.answer import Failure
from rack.tools.plots.graph import build_graph
from rack.tools.report.report import write_report
from tests.shared_runs import record

pytestmark = pytest.mark.thorough

GUARDED = (7, 16)
"""Numbers of the requests that lower the blocks."""
TOUCHES = (0.4735, 0.5236)
"""Heights of the tool at which the blocks stand, m; a braking just before lets it press some mm
further."""
MUTES = [*(("servo", at) for at in np.arange(8.25, 27.0, 0.5)), ("motion", 10.0), ("motion", 19.5)]
"""Boards that write nothing for five cycles, and when, s: enough of them come while a block is
lowered."""


def test_brakings_while_each_block_is_lowered_count_as_no_touch_and_each_is_put_down(
    tmp_path: Path,
) -> None:
    faults = ", ".join(f"{{kind='mute', board='{name}', at={at}, cycles=5}}" for name, at in MUTES)
    settings = [f"name=test-ibm-{os.getpid()}", "clock.mode=lockstep", f"fault=[{faults}]"]
    recording = record(load("ibm", settings), None, tmp_path / "run")
    ticks, current = (
        recording.read_signal("motion.status", field) for field in ("tick", "current")
    )
    braked = recording.read_signal("arm.status", "tick")[
        recording.read_signal("arm.status", "braked") == 1
    ]
    for request in GUARDED:
        lowering = ticks[current == request]
        assert len(set(braked) & set(range(lowering[0] + 1000, lowering[-1] - 500)))

    printed = [event["text"] for event in recording.events if event["kind"] == "printed"]
    assert ["touched" in text for text in printed] == [True, True]
    assert [float(text.split()[-2]) for text in printed] == pytest.approx(TOUCHES, abs=4e-3)
    report = write_report(recording.folder)[0]
    assert (report["worked"], report["outcome"]["cause"]) == (True, "task done")
    assert [end["object"] for end in report["objects"]] == ["block1", "block2"]
    assert all(end["off_mm"] < 5.0 and end["drops"] == [] for end in report["objects"])


REFUSED = {
    "stop.input=size.output": "stop.input takes a flag; size.output is a number in N m",
    "high.input=arm.velocity.j2": (
        "high.input takes a number in N m; arm.velocity.j2 is a number in rad/s"
    ),
    "size.input=size.output": ("size.input=size.output closes the cycle size > size; add a delay"),
    "stop.input=ligth.output": "no output 'ligth.output'; did you mean 'light.output'?",
}
"""Connections that the blocks refuse, and why."""


def test_a_connection_made_while_it_runs_ends_the_next_guarded_motion_sooner_and_repeats(
    tmp_path: Path,
) -> None:
    # The stop of the first block is as before, that of the second listens to a lighter touch.
    wires = dict(zip(REFUSED, (2.0, 4.0, 6.0, 8.0), strict=True)) | {"stop.input=light.output": 15}
    commands = ", ".join(
        f"{{level='blocks', what='set', name='wire=\"{wire}\"', at={at}}}"
        for wire, at in wires.items()
    )
    settings = [f"name=test-ibm-{os.getpid()}", "clock.mode=lockstep", f"command=[{commands}]"]
    config = load("ibm", settings)
    recording = record(config, None, tmp_path / "run")
    texts = [event["text"] for event in recording.events if event["kind"] == "printed"]
    heights = [float(text.split()[-2]) for text in texts if "touched" in text]
    assert heights[0] == pytest.approx(0.4737, abs=1e-4)
    assert heights[1] == pytest.approx(0.5241, abs=1e-4)
    objections = recording.read_signal("blocks.status", "objection").tolist()
    assert [text for text in dict.fromkeys(objections) if text] == list(REFUSED.values())
    # It takes effect in the first cycle after its tick.
    wired = recording.read_signal("blocks.status", "wired")[:, 0]
    tick = recording.read_signal("blocks.status", "tick")
    assert tick[1:][np.diff(wired) != 0].tolist() == [15005]
    with Rack(config) as again:
        assert again.run().digest == write_report(recording.folder)[0]["digest"]


def test_the_graph_shows_the_present_connections_of_blocks(tmp_path: Path) -> None:
    settings = [f"name=test-ibm-graph-{os.getpid()}", "clock.mode=lockstep"]
    with Rack(load("ibm/light-touch", settings)) as rack:
        rack.run(7.5)
        blocks = build_graph(rack.segment)
        status(rack.segment.rack, tmp_path / "graph.svg")
        with pytest.raises(Failure, match=r"--graph graph.pdf: the name .* end in .png or .svg"):
            status(rack.segment.rack, Path("graph.pdf"))
    assert (blocks.rows["arm.torque.j2"], blocks.rows["slow"], blocks.rows["change"]) == (0, 1, 2)
    assert blocks.edges["light", "stop"] == "input"
    assert ("high", "stop") not in blocks.edges
    assert blocks.nodes["slow"].startswith("slow\nsmooth 0.1\n")
    assert blocks.nodes["arm.torque.j2"] == "arm.torque.j2\nN m"
    assert "</svg>" in (tmp_path / "graph.svg").read_text()
