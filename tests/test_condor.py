"""The rack condor, with real processes in lockstep.

The workstation plans the grasp and writes memory words, the boards grasp and interrupt each other.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.config import build_rack_timing, load, resolve_layout
from rack.boards.timing.verdicts import evaluate_rack
from rack.levels.systems.hand.messages import GraspKind
from rack.tools.recording.recording import Recording
from tests.tools.command_line import rack

pytestmark = pytest.mark.thorough
FINGERS = ("index", "middle", "ring", "thumb")


SECONDS = 2.5
"""The grasp has then begun to squeeze more."""
WRITES = "host.workstation.params.writes=[{ at = 0.6, word = 0, value = 2500 }]"
WRITTEN_S = 1.25
"""The workstation has written by then."""
FORKED_S = 0.5


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in which the workstation orders a grasp, and then writes a word."""
    folder = tmp_path_factory.mktemp("condor") / "run"
    settings = ("--set", f"name=test-condor-{os.getpid()}", "--set", WRITES)
    rack("run", "condor", *settings, "--lockstep", "--seconds", SECONDS, "--out", folder)
    return folder


def test_an_order_of_the_workstation_comes_to_the_fingers_as_interrupts(run: Path) -> None:
    recording = Recording(run)
    status = recording.read_rows("coordinator.status")
    plan = status["message"]["plan"]
    assert plan[status["message"]["kind"] == GraspKind.CLOSE][0] == 1
    normal = recording.read_rows("adapter.plan")["message"]["normal"][-1]
    # Each finger is on its side of the can, and both sensed the hand a tick before they commanded.
    assert (normal[:3] * normal[3]).sum(axis=1).max() < -0.99
    for finger in ("index", "thumb"):
        rows = recording.read_rows(f"{finger}.command")
        sampled = rows["message"]["sampled"]
        assert np.unique((rows["tick"] - sampled)[sampled > 20]).tolist() == [1]


def read_between(run: Path, first: int, end: int) -> dict[str, np.ndarray]:
    """Return the messages of a run from releases between two ticks, by mailbox."""
    recording, found = Recording(run), {}
    for box in recording.mailboxes:
        rows = recording.read_rows(box)
        found[box] = rows["message"][(first <= rows["tick"]) & (rows["tick"] < end)]
    return found


def test_a_word_of_the_workstation_acts_at_a_tick_and_is_entered_again(
    run: Path, rack_name: str, tmp_path: Path
) -> None:
    words = Recording(run).read_rows("adapter.words")
    force = words["message"]["word"][:, 0]
    assert force.tolist()[-1] == 2500
    written_s = int(words["tick"][np.argmax(force)]) * 1.25e-3
    # After the time of the first check and that of computing, in a cycle of the adapter.
    assert 0.6 < written_s < WRITTEN_S - 0.1
    grip = Recording(run).read_rows("coordinator.status")
    squeezed = grip["message"]["kind"] >= GraspKind.SHIFT
    base = Recording(run).read_rows("adapter.plan")["message"]["grip"][-1]
    assert grip["message"]["grip"][squeezed].min() > base + 2.4
    # Its entries alone, and a branch, go on past the word.
    settings = ("--seconds", WRITTEN_S, "--out")
    again = ("--set", f"name={rack_name}", "--lockstep", "--entries", run)
    rack("run", "condor", *again, *settings, tmp_path / "entered")
    rack("run", "--from", f"{run}@{FORKED_S}", *settings, tmp_path / "branch")
    end = int((WRITTEN_S - 0.1) / 1.25e-3)
    forked = int(FORKED_S / 1.25e-3)
    for folder, first in (("entered", 0), ("branch", forked)):
        expected = read_between(run, first, end)
        found = read_between(tmp_path / folder, first, end)
        assert set(found) == set(expected) >= {f"{finger}.command" for finger in FINGERS}
        assert not [box for box in found if not np.array_equal(found[box], expected[box])], folder


def test_handlers_that_preempt_the_fingers_are_predicted_and_make_them_late(
    rack_name: str,
) -> None:
    # The order of the coordinator then comes while the fingers compute.
    settings = ["board.coordinator.phase=1"]
    for core, name in enumerate(FINGERS, 2):
        settings += [f"board.{name}.budget.process_ms=0.9", f"board.{name}.core={core}"]
    slow = "protocol.interrupt.fixed_us=350"
    soon = [f"board.{name}.budget.send_within_ms=1.25" for name in FINGERS]
    for extra, is_late in ((soon, False), ([slow], False), ([slow, *soon], True)):
        config = load("condor", [f"name={rack_name}", "clock.mode=lockstep", *settings, *extra])
        timing = build_rack_timing(config, resolve_layout(config))
        assert [v.subject for v in evaluate_rack(timing) if not v.holds] == list(FINGERS) * is_late
        found = []
        # Runs with late fingers repeat as well.
        for _ in range(1 + is_late):
            with Rack(config) as crate:
                outcome = crate.run(0.15)
                blocks = {name: crate.segment.get_block(name) for name in FINGERS}
                counts = [(b[Block.CYCLES], b[Block.MISSED]) for b in blocks.values()]
            found.append((outcome.digest, counts))
        assert found[0] == found[-1]
        for cycles, missed in found[0][1]:
            # One order in four cycles of a finger.
            assert missed == (pytest.approx(cycles / 4, abs=2) if is_late else 0)
