"""The rack condor, with real processes in lockstep.

The workstation plans the grasp and writes memory words, the boards grasp and interrupt each other.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import Message
from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.config import build_rack_timing, load, resolve_layout
from rack.boards.timing.verdicts import evaluate_rack
from rack.levels.systems.hand.messages import GraspKind
from rack.tools.recording.recording import Recording
from tests.processes import wait_until
from tests.tools.command_line import rack

pytestmark = pytest.mark.slow
FINGERS = ("index", "middle", "ring", "thumb")


def test_an_order_of_the_workstation_comes_to_the_fingers_as_interrupts() -> None:
    settings = [f"name=test-condor-{os.getpid()}", "clock.mode=lockstep"]
    with Rack(load("condor", settings)) as crate:
        crate.start()
        grasp = open_observer(crate.segment, "coordinator.status")

        def status() -> Message:
            crate.watch(0.02)
            return grasp.peek().message

        wait_until(lambda: status().kind == GraspKind.CLOSE)
        assert status().plan == 1
        crate.stop("seen enough")
        plan = open_observer(crate.segment, "adapter.plan").peek().message
        tensions = [
            MailboxRing(crate.segment, f"{finger}.command").read_new_rows().rows
            for finger in ("index", "thumb")
        ]
    # Each finger is on its side of the can, and both sensed the hand a tick before they commanded.
    assert (plan.normal[:3] * plan.normal[3]).sum(axis=1).max() < -0.99
    for rows in tensions:
        sampled = rows["message"]["sampled"]
        assert np.unique((rows["tick"] - sampled)[sampled > 20]).tolist() == [1]


SECONDS = 2.75
"""The grasp has then squeezed for a third of a second."""
WRITES = "host.workstation.params.writes=[{ at = 1.5, word = 0, value = 2500 }]"


def test_a_word_of_the_workstation_acts_at_a_tick_and_is_entered_again(
    rack_name: str, tmp_path: Path
) -> None:
    settings = ("--set", f"name={rack_name}", "--lockstep", "--seconds", SECONDS)
    one, two, three = (tmp_path / name for name in ("one", "two", "three"))
    rack("run", "condor", *settings, "--set", WRITES, "--out", one)
    rack("run", "condor", *settings, "--entries", one, "--out", two)
    rack("run", "--from", f"{one}@1.0", "--seconds", SECONDS, "--out", three)
    reports = [json.loads((run / "report.json").read_text()) for run in (one, two, three)]
    assert len({report["digest"] for report in reports}) == 1
    runs = [Recording(run) for run in (one, two)]
    words = [run.read_rows("adapter.words") for run in runs]
    assert np.array_equal(words[0]["message"], words[1]["message"])
    force = words[0]["message"]["word"][:, 0]
    assert force.tolist()[-1] == 2500
    written = int(words[0]["tick"][np.argmax(force)])
    # After the time of the first check and that of computing, in a cycle of the adapter.
    assert 1.5 < written * 1.25e-3 < 2.5
    grip = runs[0].read_rows("coordinator.status")
    squeezed = grip["message"]["kind"] >= GraspKind.SHIFT
    base = runs[0].read_rows("adapter.plan")["message"]["grip"][-1]
    assert grip["message"]["grip"][squeezed].min() > base + 2.4


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
        failed = [v.subject for v in evaluate_rack(timing) if not v.holds]
        assert failed == list(FINGERS) * is_late
        found = []
        # Runs with late fingers repeat as well.
        for _ in range(1 + is_late):
            with Rack(config) as crate:
                outcome = crate.run(0.3)
                blocks = {name: crate.segment.get_block(name) for name in FINGERS}
                counts = [(b[Block.CYCLES], b[Block.MISSED]) for b in blocks.values()]
            found.append((outcome.digest, counts))
        assert found[0] == found[-1]
        for cycles, missed in found[0][1]:
            # One order in four cycles of a finger.
            assert missed == (pytest.approx(cycles / 4, abs=2) if is_late else 0)
