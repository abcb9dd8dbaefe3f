"""Boards that die or hang rejoin the grid, as their policy permits; in lockstep such a run is
repeatable."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence

import pytest

from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event, Outcome
from tests.boards.conftest import LOOSE, PLAIN, MakeConfig
from tests.boards.crate.test_kill import TASKS, process_of
from tests.boards.messages import Written
from tests.boards.runs import faulty, kill, run_until, watch_until

RESTART_TICKS = 200
"""Ticks of 2.5 ms after which a board comes back in lockstep: 0.5 s."""


def run(config: RackConfig, seconds: float = 2.0) -> tuple[Outcome, list[Event]]:
    """Run a rack for some simulated time; return how it ended and what happened."""
    with Rack(config) as rack:
        return rack.run(seconds), rack.events


def of(events: Sequence[Event], kind: str, code: str = "") -> list[Event]:
    """Return the events of a kind, and with a code of that alone."""
    return [event for event in events if event.kind == kind and code in ("", event.code)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("victim", "kind"), [("wave", "kill"), ("wave.planner", "kill"), ("watch", "hang")]
)
def test_a_lost_board_is_back_on_the_grid_at_its_tick(
    config: MakeConfig, victim: str, kind: str
) -> None:
    outcome, events = run(faulty(config(), {"kind": kind, "board": victim, "tick": 100}))
    assert outcome.cause == "time over"
    assert outcome.is_success
    every = 8 if victim == "watch" else 1
    lost = 100 if kind == "kill" else of(events, "detection", "hang")[0].tick
    (back,) = of(events, "recovery", "rejoined")
    assert back.board == victim
    assert back.tick == lost + RESTART_TICKS
    if kind == "hang":
        assert 100 + 3 * every <= lost <= 100 + 5 * every
    assert [e.text for e in of(events, "reaction", "restart")] == ["restart 1 of at most 5 in 10 s"]


@pytest.mark.slow
def test_a_run_with_its_faults_repeats(config: MakeConfig) -> None:
    faults = [kill(victim, 90 + 150 * k) for k, victim in enumerate(TASKS)]
    faults += [
        {"kind": "hang", "board": "watch", "tick": 600},
        {"kind": "clock-skip", "board": "clock", "tick": 650},
    ]
    first, second = (run(faulty(config(*LOOSE), *faults), 2.2)[0].digest for _ in range(2))
    assert first == second != run(config(*LOOSE), 2.2)[0].digest


def test_a_restarted_writer_continues_its_serials_in_a_new_epoch(config: MakeConfig) -> None:
    with Rack(faulty(config(), kill("wave", 100))) as rack:
        rack.run(1.0)
        rows = Written.on(rack.segment).messages["wave.status"]
    assert rows["serial"].tolist() == list(range(1, len(rows) + 1))
    assert rows["tick"].tolist() == [*range(100), *range(300, 400)]
    assert sorted(set((rows["epoch"] & 0xFFFFFFFF).tolist())) == [1, 2]


@pytest.mark.slow
def test_a_killed_clock_continues_with_the_tick_it_died_in(config: MakeConfig) -> None:
    plain, _ = run(config())
    killed, events = run(faulty(config(), kill("clock", 300)))
    assert of(events, "recovery", "rejoined")[0].board == "clock"
    assert killed.digest == plain.digest


def test_a_board_that_is_lost_too_often_is_given_up_and_the_latch_is_set(
    config: MakeConfig,
) -> None:
    faults = [kill("wave", 50 + 250 * k) for k in range(3)]
    with Rack(faulty(config("supervision.restarts=2"), *faults)) as rack:
        outcome = rack.run(5.0)
        assert rack.segment.words[System.EMERGENCY_STOP] == 1
    assert outcome.cause == "board lost"
    assert "no restarts left" in outcome.faults[0]
    assert [event.text[:9] for event in of(rack.events, "reaction", "restart")] == [
        "restart 1",
        "restart 2",
    ]
    demand = of(rack.events, "reaction", "demand")[0]
    assert demand.subject == "emergency stop"
    # The third loss, the outage, and half a second in which the arm comes to rest.
    assert outcome.ticks == demand.tick + RESTART_TICKS


@pytest.mark.slow
def test_restarts_are_counted_within_their_time_window_only(config: MakeConfig) -> None:
    faults = [kill("wave", 50 + 400 * k) for k in range(4)]
    settings = ("supervision.restarts=1", "supervision.within_s=0.9")
    outcome, _ = run(faulty(config(*settings), *faults), 5.0)
    assert outcome.cause == "time over"


@pytest.mark.slow
@pytest.mark.parametrize(("on_loss", "demand"), [("hold", []), ("stop", [1.0, 0.0])])
def test_a_loss_has_the_configured_effect_on_the_arm(
    config: MakeConfig, on_loss: str, demand: list[float]
) -> None:
    _, events = run(faulty(config(f"board.wave.on_loss={on_loss}"), kill("wave", 100)))
    found = [event for event in events if event.code == "demand"]
    assert [event.value for event in found] == demand
    assert [event.tick for event in found] == [100, 300][: len(demand)]


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["wave.planner", "clock"])
def test_a_kill_from_outside_in_real_time_is_survived(config: MakeConfig, victim: str) -> None:
    with Rack(config("clock.mode=realtime")) as rack:
        rack.start()
        words = rack.segment.words
        watch_until(rack, lambda: words[System.TICK] >= 40)
        os.kill(process_of(rack, victim), signal.SIGKILL)
        outcome = run_until(rack, lambda: of(rack.events, "recovery", "rejoined"))
    assert (outcome.cause, outcome.is_success) == ("time over", True)
    assert [event.board for event in of(rack.events, "died")] == [victim]
    assert [event.board for event in of(rack.events, "recovery", "rejoined")] == [victim]


@pytest.mark.slow
def test_a_stopped_clock_is_detected_by_the_fastest_board(config: MakeConfig) -> None:
    fault = {"kind": "clock-stop", "board": "clock", "tick": 40}
    with Rack(faulty(config("clock.mode=realtime"), fault)) as rack:
        events = rack.events
        rack.start()
        outcome = run_until(rack, lambda: of(events, "recovery", "rejoined"))
    (stopped,) = of(events, "detection", "clock_stopped")
    assert stopped.board == "wave"
    # The clock itself may have been late and skipped the fault's tick.
    assert stopped.since == of(events, "fault", "begins")[0].tick
    assert of(events, "recovery", "rejoined")[0].board == "clock"
    assert outcome.is_success


@pytest.mark.slow
def test_a_late_alarm_about_a_dead_clock_does_not_end_its_successor(config: MakeConfig) -> None:
    with Rack(config("clock.mode=realtime")) as rack:
        rack.start()
        words = rack.segment.words
        watch_until(rack, lambda: words[System.TICK] >= 40)
        dead = words[System.CLOCK_PID]
        os.kill(dead, signal.SIGKILL)
        watch_until(rack, lambda: of(rack.events, "recovery", "rejoined"))
        AlarmWriter(rack.segment, "watch").raise_alarm(
            words[System.TICK], Alarm.CLOCK_STOPPED, dead, 3, 40
        )

        def reporters() -> list[str]:
            return [event.board for event in of(rack.events, "detection", "clock_stopped")]

        run_until(rack, lambda: "watch" in reporters())
    assert [event.board for event in of(rack.events, "died")] == ["clock"]


@pytest.mark.slow
def test_a_latch_set_while_running_brakes_until_it_is_reset(config: MakeConfig) -> None:
    with Rack(config("clock.mode=realtime")) as rack:
        rack.start()
        words = rack.segment.words
        for latch, demand in ((1, 2), (0, 0)):
            words[System.EMERGENCY_STOP] = latch
            watch_until(rack, lambda demand=demand: words[System.DEMAND] == demand)  # type: ignore[misc]
            tick = words[System.TICK]
            watch_until(rack, lambda tick=tick: words[System.TICK] >= tick + 40)  # type: ignore[misc]
            assert words[System.DEMAND] == demand
        run_until(rack, lambda: True)
    assert [event.kind for event in rack.events if event.code == "demand"] == [
        "reaction",
        "recovery",
    ]


@pytest.mark.slow
def test_a_board_that_fails_within_a_batch_fails_at_the_tick_of_its_cycle(
    config: MakeConfig,
) -> None:
    _, events = run(config("board.wave.params={ trouble = 'raise', at = 101 }", text=PLAIN))
    assert [event.tick for event in of(events, "died")] == [101]
    assert [event.tick for event in of(events, "recovery", "rejoined")] == [101 + RESTART_TICKS]
