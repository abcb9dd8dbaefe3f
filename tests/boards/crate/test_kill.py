"""Death, anywhere: the others end within their bounds, and nothing is left."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.backplane.segment import Segment, list_racks
from rack.backplane.words import Block, System
from rack.boards import Rack
from rack.boards.crate.clean import remove_dead_rack
from tests.boards.conftest import LOOSE, NEVER, MakeConfig
from tests.boards.programs import launcher
from tests.boards.runs import end_of
from tests.conftest import EXHAUSTIVE
from tests.processes import children_of, named, parent_of, runs, wait_until

REALTIME = "clock.mode=realtime"
TASKS = ("wave", "wave.planner", "watch")


def running(rack: Rack, seconds: float | None = None) -> None:
    """Start a rack, and return once it has done some cycles."""
    rack.start(seconds)
    wait_until(lambda: rack.segment.words[System.TICK] > 20)


def process_of(rack: Rack, name: str) -> int:
    """Return the process of a task, of the clock, or of the crate, which is the parent of them
    all."""
    if name in TASKS:
        return rack.segment.get_block(name)[Block.PID]
    crate = parent_of(rack.segment.get_block(TASKS[0])[Block.PID])
    boards = {rack.segment.get_block(task)[Block.PID] for task in TASKS}
    return (
        crate if name == "crate" else next(pid for pid in children_of(crate) if pid not in boards)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("victim", "coupling"),
    [("wave", ()), ("wave.planner", LOOSE), ("watch", LOOSE), ("clock", ()), ("crate", ())],
)
def test_a_killed_process_ends_the_run_with_its_name(
    config: MakeConfig, victim: str, coupling: tuple[str, ...]
) -> None:
    mode = "lockstep" if coupling else "realtime"
    with Rack(config(f"clock.mode={mode}", NEVER, *coupling)) as rack:
        running(rack)
        family = [process_of(rack, name) for name in (*TASKS, "clock", "crate")]
        words = rack.segment.words
        before = words[System.TICK]
        os.kill(process_of(rack, victim), signal.SIGKILL)
        outcome = end_of(rack)
        # The clock may outlive the crate by a moment, in which it begins further ticks, or obeys
        # the Rack, which has seen that the crate is gone.
        assert victim != "crate" or before + 1 <= outcome.ticks <= words[System.TICK] + 1
    assert (outcome.cause, outcome.is_success) == ("board lost", False)
    text = "the crate ended" if victim == "crate" else f"board '{victim}' ended: signal SIGKILL"
    assert any(text in fault for fault in outcome.faults)
    assert next(event.board for event in rack.events if event.kind == "died") == victim
    wait_until(lambda: not any(runs(pid) for pid in family))


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["wave.planner", "clock", "crate"])
def test_a_process_killed_before_the_start_ends_the_run_too(
    config: MakeConfig, victim: str
) -> None:
    with Rack(config(REALTIME, NEVER)) as rack:
        if victim == "clock":
            rack.start()
            wait_until(lambda: len(children_of(process_of(rack, "crate"))) > len(TASKS))
        os.kill(process_of(rack, victim), signal.SIGKILL)
        if victim != "clock":
            rack.start()
        assert end_of(rack).cause == "board lost"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("victim", "mode"), [("wave", "realtime"), ("clock", "realtime"), ("wave", "lockstep")]
)
def test_a_stopped_process_is_reported_as_hanging(
    config: MakeConfig, victim: str, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rack.boards.crate.heartbeat.LOCKSTEP_S", 0.5)
    with Rack(config(f"clock.mode={mode}", NEVER)) as rack:
        running(rack)
        os.kill(process_of(rack, victim), signal.SIGSTOP)
        outcome = end_of(rack)
    assert outcome.cause == "board lost"
    found = {event.code: event for event in rack.events if event.kind == "detection"}
    assert "clock_stopped" in found if victim == "clock" else found["hang"].subject == victim
    assert f"board '{victim}' ended: signal SIGKILL" in outcome.faults[0]


@pytest.mark.slow
def test_a_stopped_crate_does_not_stop_the_run_nor_its_end(
    config: MakeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rack.boards.crate.rack.BOARDS_END_S", 0.2)
    with Rack(config(REALTIME)) as rack:
        rack.start(0.25)
        wait_until(lambda: rack.segment.words[System.TICK] > 5)
        crate = process_of(rack, "crate")
        os.kill(crate, signal.SIGSTOP)
        assert end_of(rack).cause == "time over"
    assert not runs(crate)


@pytest.mark.slow
def test_a_run_that_was_stopped_has_the_ticks_that_its_clock_made(config: MakeConfig) -> None:
    with Rack(config("clock.mode=lockstep", NEVER)) as rack:
        running(rack, 10_000.0)
        # The clock waits for this task, and does not see the request to stop.
        os.kill(process_of(rack, "wave"), signal.SIGSTOP)
        rack.stop("test")
        outcome = end_of(rack)
        assert outcome.cause == "stopped"
        assert outcome.ticks == rack.segment.words[System.TICK] + 1


@pytest.mark.slow
def test_a_level_that_raises_is_reported_with_its_reason(config: MakeConfig) -> None:
    with Rack(config("board.wave.params={ trouble = 'raise', at = 30 }", NEVER)) as rack:
        rack.start()
        outcome = end_of(rack)
    assert outcome.cause == "board lost"
    assert "board 'wave' ended: exit status 1" in outcome.faults[0]
    printed = [event.text for event in rack.events if event.kind == "printed"]
    assert any("ValueError: no wave at tick 30" in line for line in printed)
    # In lockstep it is given up when it would have rejoined, 0.5 s later; the arm gets 0.5 s to
    # come to rest.
    assert outcome.ticks == 30 + 200 + 200


def test_an_error_in_the_users_own_code_takes_the_rack_down(config: MakeConfig) -> None:
    family: list[int] = []

    def use(rack: Rack) -> None:
        with rack:
            running(rack)
            family.extend(process_of(rack, name) for name in (*TASKS, "clock", "crate"))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        use(Rack(config(REALTIME)))
    assert not any(runs(pid) for pid in family)


@pytest.fixture
def waves(config: MakeConfig, rack_name: str, tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """The file of a rack in real time, and its name; what a killed launcher has left is removed at
    the end."""
    config()
    yield tmp_path / "waves.toml", f"name={rack_name}"
    remove_dead_rack(rack_name)


@pytest.mark.slow
def test_a_process_that_the_launcher_forked_does_not_keep_its_rack(waves: tuple[Path, str]) -> None:
    with launcher(*waves, REALTIME, "--fork") as program:
        program.wait_for_launch()
        program.send(signal.SIGKILL)
        program.ended()
        # Only the launcher's own child is left.
        wait_until(lambda: len(program.descendants) == 1)


@pytest.mark.slow
def test_the_next_launch_takes_a_killed_racks_name(
    config: MakeConfig, waves: tuple[Path, str], rack_name: str
) -> None:
    with launcher(*waves, REALTIME) as program:
        program.wait_for_launch()
        assert len(program.descendants) >= 4
        program.send(signal.SIGKILL)
        program.ended()
        # The segment stays for inspection, until the next launch or 'rack clean' removes it.
        assert not Segment.attach(rack_name).launcher_is_alive
        with Rack(config()) as rack:
            assert rack.run(0.1).cause == "time over"
        program.wait_for_descendants()
    assert rack_name not in list_racks()


@pytest.mark.slow
@pytest.mark.parametrize(("number", "is_gone"), [(signal.SIGINT, True), (signal.SIGTERM, False)])
def test_an_interrupted_launcher_leaves_no_process_and_removes_its_segment_if_it_can(
    waves: tuple[Path, str], rack_name: str, number: signal.Signals, is_gone: bool
) -> None:
    with launcher(*waves, REALTIME) as program:
        program.wait_for_launch()
        program.send(number)
        assert program.ended() != 0
        assert not is_gone or (rack_name not in list_racks() and not program.descendants)
        program.wait_for_descendants()


@pytest.mark.slow
def test_a_launcher_killed_at_any_moment_leaves_nothing_behind_the_next_clean(
    waves: tuple[Path, str], rack_name: str
) -> None:
    rng = random.Random(11)
    for round_ in range(40 if EXHAUSTIVE else 3):
        with launcher(*waves, REALTIME) as program:
            # From the first import to the first cycles; half of the times a segment exists.
            if round_ % 2:
                wait_until(lambda: rack_name in list_racks())
            time.sleep(rng.uniform(0.0, 0.5))
            program.send(signal.SIGKILL)
            program.ended()
            program.wait_for_descendants()
        remove_dead_rack(rack_name)
        assert rack_name not in list_racks()
        assert not named(f"{rack_name}:")


@pytest.mark.slow
def test_a_board_killed_at_any_moment_does_not_count_as_hanging(config: MakeConfig) -> None:
    rng = random.Random(5)
    for _ in range(40 if EXHAUSTIVE else 2):
        with Rack(config(REALTIME, NEVER)) as rack:
            rack.start()
            time.sleep(rng.uniform(0.0, 0.06))
            os.kill(process_of(rack, rng.choice(TASKS)), signal.SIGKILL)
            assert end_of(rack).cause == "board lost"
