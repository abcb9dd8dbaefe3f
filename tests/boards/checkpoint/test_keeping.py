"""A run in lockstep continues from each of its checkpoints, to the same digest."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from rack.boards import Rack
from rack.boards.checkpoint.format import ATTRIBUTES, FOLDER, NAME, checkpoints
from rack.boards.checkpoint.restoring import unkept
from rack.boards.config import resolve
from rack.boards.config.schema import RackConfig
from rack.boards.errors import UNKEPT, CheckpointError
from rack.boards.events import Event, Outcome
from rack.boards.faults.config import FaultConfig
from rack.boards.wiring import Keeping
from tests.boards.conftest import CLOCK, LOOSE, MakeConfig

SECONDS = 1.0
EVERY = 70
REMEMBERING = f"""{CLOCK}
[board.wave]
slot = 2
rate_hz = 400
executor = "remembering_levels:Rememberer"

[board.watch]
slot = 3
rate_hz = 50
below = "wave"
executor = "wave_levels:Watch"
ends_run = true
"""


def kept(config: RackConfig, run: Path, every: int = EVERY) -> tuple[Outcome, list[Event]]:
    """Run a rack that takes checkpoints in the folder of a run."""
    folder = run / FOLDER
    folder.mkdir(parents=True)
    with Rack(config, keeping=Keeping(folder, every)) as rack:
        return rack.run(SECONDS), rack.events


def continued(
    config: RackConfig, origin: Path, known: RackConfig | None = None, **losses: Any
) -> Outcome:
    """Continue a run of `known`, or of the same config, from a checkpoint."""
    known = known or config
    keeping = Keeping(origin=origin, packages=config.python_path, faults=len(known.fault), **losses)
    with Rack(config, keeping=keeping) as rack:
        return rack.run(SECONDS)


def faulty(config: RackConfig, *faults: dict[str, Any]) -> RackConfig:
    """Return the config with these faults."""
    return config.model_copy(update={"fault": tuple(FaultConfig(**fault) for fault in faults)})


@pytest.mark.slow
@pytest.mark.parametrize("settings", [(), LOOSE, ("protocol.default=lock",)])
def test_a_run_continues_from_each_checkpoint_to_the_same_digest(
    config: MakeConfig, tmp_path: Path, settings: Sequence[str]
) -> None:
    rack = config(*settings)
    with Rack(rack) as plain:
        expected = plain.run(SECONDS)
    outcome, _ = kept(rack, tmp_path)
    assert outcome.digest == expected.digest
    found = checkpoints(tmp_path)
    assert list(found) == [70, 140, 210, 280, 350]
    ends = [continued(rack, path) for path in found.values()]
    assert {(end.digest, end.ticks) for end in ends} == {(expected.digest, expected.ticks)}


@pytest.mark.slow
def test_all_that_a_level_remembers_is_in_a_checkpoint(config: MakeConfig, tmp_path: Path) -> None:
    rack = config(text=REMEMBERING)
    outcome, events = kept(rack, tmp_path, 1 + EVERY // 5)
    assert not [event for event in events if event.kind == "printed"]
    found = checkpoints(tmp_path)
    for tick in (min(found), 210, max(found)):
        assert continued(rack, found[tick]).digest == outcome.digest


@pytest.mark.slow
def test_a_checkpoint_at_a_tick_comes_with_the_attributes_of_its_levels(
    config: MakeConfig, tmp_path: Path
) -> None:
    rack = config(text=REMEMBERING)
    keeping = Keeping(tmp_path, at=210, shows=True)
    with Rack(rack, keeping=keeping) as first:
        first.run(210 * rack.clock_ns * 1e-9)
    assert [path.name for path in tmp_path.glob("*.checkpoint")] == [NAME.format(210)]
    shown = json.loads((tmp_path / f"wave{ATTRIBUTES}").read_text())
    assert (shown["_factor"], shown["_half"], shown["_list"]) == (1.0, 0.5, "210 items")
    assert shown["_recent"] == [tick % 7 for tick in range(205, 210)]
    assert sorted(shown["_odd"]) == [tick for tick in range(13) if len(range(tick, 210, 13)) % 2]
    turned = 0.125 * len(range(20, 210))
    assert shown["_turn"] == {"of": [turned, 0.0], "size": 0.125}
    # Shared state is shown as it is; functions are not.
    assert shown["_table"] == [[0.0, 0.0, 0.0], [0.0, turned, 0.0]]
    assert not {"context", "_call", "_next"} & set(shown)


@pytest.mark.slow
def test_a_task_that_has_ended_ends_the_run_that_continues(
    config: MakeConfig, tmp_path: Path
) -> None:
    rack = config("board.wave.params.done_at=100")
    with Rack(rack) as plain:
        expected = plain.run()
    with Rack(rack, keeping=Keeping(tmp_path, at=140)) as first:
        assert first.run(140 * rack.clock_ns * 1e-9).ticks == 140 < expected.ticks
    with Rack(rack, keeping=Keeping(origin=tmp_path / NAME.format(140))) as again:
        outcome = again.run()
    assert (outcome.cause, outcome.ticks) == ("task done", expected.ticks)
    assert outcome.digest == expected.digest


@pytest.mark.slow
def test_a_branch_goes_another_way_from_the_tick_of_its_checkpoint(
    config: MakeConfig, tmp_path: Path
) -> None:
    rack = config(text=REMEMBERING)
    outcome, _ = kept(rack, tmp_path)
    origin = checkpoints(tmp_path)[210]
    other = config("board.wave.params.factor=2.0", text=REMEMBERING)
    struck = faulty(rack, {"kind": "kill", "board": "wave", "tick": 220})
    branches = [continued(other, origin), continued(struck, origin, known=rack)]
    assert len({outcome.digest, *(branch.digest for branch in branches)}) == 3
    # The new parameter, and what the constructor made of it; the past is the other's.
    with Rack(other) as whole:
        assert whole.run(SECONDS).digest not in (outcome.digest, branches[0].digest)


@pytest.mark.slow
def test_a_run_with_faults_restarts_and_skipped_ticks_continues(
    config: MakeConfig, tmp_path: Path
) -> None:
    rack = faulty(
        config("supervision.lockstep_restart_s=0.1"),
        {"kind": "kill", "board": "wave", "tick": 100},
        {"kind": "drop", "board": "wave", "mailbox": "wave.status", "tick": 60, "cycles": 9},
        {"kind": "clock-skip", "board": "clock", "tick": 180},
        {"kind": "kill", "board": "wave.planner", "tick": 250},
    )
    outcome, _ = kept(rack, tmp_path, 35)
    found = checkpoints(tmp_path)
    # Those that fall into an outage, of 40 ticks, are taken when it is over.
    assert list(found) == [35, 70, 141, 175, 210, 245, 291, 315, 350, 385]
    for path in found.values():
        assert continued(rack, path).digest == outcome.digest


@pytest.mark.slow
def test_restarts_before_a_checkpoint_count_after_it(config: MakeConfig, tmp_path: Path) -> None:
    rack = faulty(
        config("supervision.restarts=1", "supervision.lockstep_restart_s=0.1"),
        {"kind": "kill", "board": "wave", "tick": 20},
        {"kind": "kill", "board": "wave", "tick": 100},
    )
    outcome, _ = kept(rack, tmp_path)
    assert outcome.cause == "board lost"
    again = continued(rack, checkpoints(tmp_path)[70], losses=(("wave", 20),))
    assert (again.cause, again.digest) == (outcome.cause, outcome.digest)


@pytest.mark.slow
def test_a_level_that_cannot_be_kept_is_named_and_runs_as_before(
    config: MakeConfig, tmp_path: Path
) -> None:
    rack = config(text=REMEMBERING.replace("Rememberer", "Generator"))
    with Rack(rack) as plain:
        expected = plain.run(SECONDS)
    outcome, events = kept(rack, tmp_path)
    assert (outcome.cause, outcome.digest) == ("time over", expected.digest)
    assert not [*(tmp_path / FOLDER).iterdir()]
    why = "wave.executor._count: a itertools.count has no checkpoint"
    (note,) = [event.text for event in events if event.kind == "ready"]
    assert note == f"{UNKEPT}{why}"
    # Before a launch its level is all that there is.
    assert unkept(resolve(rack)) == why.replace("wave.executor", "wave")


@pytest.mark.slow
def test_one_that_cannot_be_kept_cannot_continue(config: MakeConfig, tmp_path: Path) -> None:
    kept(config(text=REMEMBERING), tmp_path)
    other = config(text=REMEMBERING.replace("Rememberer", "Generator"))
    with pytest.raises(CheckpointError, match=r"a itertools\.count has no checkpoint"):
        continued(other, checkpoints(tmp_path)[140])


def test_levels_that_can_be_kept_have_nothing_to_say(config: MakeConfig) -> None:
    assert unkept(resolve(config())) == unkept(resolve(config(text=REMEMBERING))) == ""


@pytest.mark.slow
def test_what_cannot_be_kept_later_costs_the_checkpoint_and_not_the_run(
    config: MakeConfig, tmp_path: Path
) -> None:
    text = REMEMBERING.replace("Rememberer", "LateGenerator")
    outcome, events = kept(config(text=text), tmp_path)
    assert outcome.cause == "time over"
    assert not checkpoints(tmp_path)
    why = "no checkpoint: wave.executor: cannot pickle 'generator' object"
    assert why in [event.text for event in events]


@pytest.mark.slow
def test_a_level_that_has_changed_shape_cannot_continue(config: MakeConfig, tmp_path: Path) -> None:
    kept(config(text=REMEMBERING), tmp_path)
    origin = checkpoints(tmp_path)[140]
    other = config(text=REMEMBERING.replace("remembering_levels:Rememberer", "wave_levels:Wave"))
    with pytest.raises(
        CheckpointError, match=r"'wave' cannot continue from .*: its class, or what"
    ):
        continued(other, origin)


@pytest.mark.slow
def test_a_checkpoint_of_another_rack_and_real_time_are_refused(
    config: MakeConfig, tmp_path: Path
) -> None:
    kept(config(), tmp_path)
    origin = checkpoints(tmp_path)[140]
    with pytest.raises(CheckpointError, match="of a rack with other tasks, mailboxes or messages"):
        continued(config(text=REMEMBERING), origin)
    with pytest.raises(CheckpointError, match="in lockstep; add --lockstep"):
        continued(config("clock.mode=realtime"), origin)
