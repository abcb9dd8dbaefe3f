"""The board of a hand, driven by one board, by four, or by none."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.watch.alarms import Alarm
from rack.boards.faults.kinds import KINDS
from rack.levels.level import Demand, Fault, Pace
from rack.levels.messages import Error
from rack.levels.operator import Operation
from rack.levels.systems.hand.executor import HandExecutor
from rack.levels.systems.hand.messages import EXTENSOR
from tests.levels.arms import config, context
from tests.levels.box import mute
from tests.levels.lockstep import Operator
from tests.levels.systems.hand.hand_rig import AMPLITUDE_RAD, CLOCK_NS, EVERY, HandRig

MUST = "must be commanded by one board; it is commanded by"
FINGERS = ("index", "middle", "ring", "thumb")


def swinging(fingers: tuple[str, ...] = FINGERS) -> HandRig:
    rig = HandRig(fingers)
    rig.cycles(60)
    assert np.abs(rig.status.velocity).max() > 0.1
    return rig


def assert_follows(rig: HandRig) -> None:
    rig.cycles(40)
    status = rig.status
    assert (status.state, status.reason) == (State.EXECUTING, "")
    assert (status.holding, status.stopped) == (0, 0)
    rig.cycles(10)
    assert np.abs(rig.status.position - status.position).min() > 1e-4


def test_four_boards_move_the_hand_as_one_does() -> None:
    together, apart = HandRig(), HandRig(FINGERS)
    for rig in (together, apart):
        rig.cycles(150)
    assert np.array_equal(together.status.position, apart.status.position)
    off = together.status.position - np.array(config("utah_mit")[0].home)
    assert np.abs(off).max() == pytest.approx(AMPLITUDE_RAD, abs=0.06)
    status = together.status
    assert (status.violations, status.touches, status.clipped) == (0, 0, 0)


def test_a_broken_simulation_is_an_error_with_its_reason() -> None:
    rig = swinging()
    rig.executor.hand.fault = "it diverged"
    rig.cycles(2)
    found = rig.status.state, rig.status.error, rig.status.reason
    assert found == (State.ERROR, Error.SIMULATION, "it diverged")


def test_hand_is_idle_until_every_board_sends_tensions() -> None:
    rig = HandRig(FINGERS)
    rig.tasks["thumb"].due = 25 * EVERY
    rig.cycles(20)
    status = rig.status
    assert (status.state, status.holding, status.stopped) == (State.IDLE, 1, 0)
    assert status.reason == "no tensions from board 'thumb' yet"
    assert status.position == pytest.approx(config("utah_mit")[0].home, abs=1e-6)
    rig.cycles(20)
    assert_follows(rig)


def test_silent_or_lost_board_closes_the_valves_until_it_is_back() -> None:
    rig = swinging()
    rig.disturb("index.command", mute, ticks=20 * EVERY)
    rig.cycles(3)
    assert not rig.executor.hand.braked
    rig.cycles(2)
    assert rig.executor.hand.braked
    rig.cycles(30)
    rig.lose("ring", ticks=50 * EVERY)
    rig.cycles(2)
    status = rig.status
    assert (status.state, status.holding, status.stopped) == (State.HOLDING, 1, 1)
    assert status.reason == "board 'ring' is lost: valves closed until it is back"
    rig.cycles(40)
    assert rig.executor.hand.braked
    rig.cycles(20)
    assert_follows(rig)


@pytest.mark.slow
@pytest.mark.parametrize("demand", [Demand.STOP, Demand.BRAKE])
def test_emergency_stop_closes_the_valves_and_keeps_the_tensions(demand: Demand) -> None:
    rig = swinging()
    rig.stop(demand, ticks=40 * EVERY)
    rig.cycles(2)
    held = rig.status
    rig.cycles(30)
    status = rig.status
    assert (status.demand, status.stopped, status.state) == (demand, 1, State.HOLDING)
    named = f"demand '{demand.name.lower()}' on the hand: valves closed until"
    assert status.reason.startswith(named)
    assert np.abs(status.velocity).max() < 0.5 * np.abs(held.velocity).max()
    assert status.tension.min() > 10.0  # it does not let go
    rig.cycles(20)
    assert_follows(rig)


def test_an_operator_holds_the_hand_with_closed_valves_until_resume() -> None:
    rig = swinging(())
    operator = Operator(rig)
    operator.say("hand", Operation.HOLD)
    rig.cycles(20)
    assert rig.executor.hand.braked
    assert (rig.status.state, rig.status.stopped) == (State.HOLDING, 1)
    assert rig.status.reason == "held by the operator: valves closed; `resume` opens them"
    operator.say("hand", Operation.RESUME)
    assert_follows(rig)


def test_tension_that_is_nan_is_refused_and_reported_once() -> None:
    rig = swinging(())
    rig.swing().override = np.nan
    rig.cycles(10)
    assert rig.executor.hand.braked
    assert rig.status.reason == "rejected: tension of 'index0', flexor is NaN"
    assert [found.alarm for found in rig.executor.findings] == [Alarm.TENSION_INVALID]
    assert np.isfinite(rig.status.wanted).all()
    rig.swing().override = None
    rig.cycles(20)
    assert_follows(rig)


@pytest.mark.parametrize(("asked", "given"), [(150.0, 100.0), (0.0, 2.0), (-30.0, 2.0)])
def test_tension_beyond_its_limits_is_cut(asked: float, given: float) -> None:
    rig = swinging(())
    rig.swing().override = asked
    rig.cycles(5)
    assert rig.status.wanted == pytest.approx(given)
    assert rig.status.clipped > 0
    found = [(finding.alarm, finding.value) for finding in rig.executor.findings]
    assert found == [(Alarm.TENSION_LIMIT, asked)]


def test_torn_tendon_is_found_within_its_bound_and_the_others_pull_on() -> None:
    rig, kind = swinging(()), KINDS["tendon-torn"]
    torn = Fault(kind.name, {"joint": 5, "side": EXTENSOR}, 1, rig.tick, kind.step)
    rig.executor.inject([torn])
    assert str(kind.bound) == "6 cycles"
    rig.cycles(6)
    assert [(found.alarm, found.subject) for found in rig.executor.findings] == [(Alarm.TENDON, 5)]
    assert rig.executor.acted
    rig.cycles(2)
    status = rig.status
    assert (status.state, status.error) == (State.EXECUTING, Error.NONE)
    assert status.reason == "slack: extensor of 'middle1'"
    assert status.tension[EXTENSOR, 5] == 0.0
    assert status.torque[5] > 0.0
    assert np.delete(status.tension, 5, axis=1).min() >= 2.0
    rig.executor.inject([])
    rig.cycles(20)
    assert rig.status.reason == ""
    assert_follows(rig)


@pytest.mark.parametrize(
    ("above", "why"),
    [
        ({"all": None}, ""),
        ({name: name for name in FINGERS}, ""),
        ({name: name for name in FINGERS[1:]}, f"joint 'index0' {MUST} none"),
        ({"all": None, "ring": "ring"}, f"joint 'ring0' {MUST} 'all', 'ring'"),
    ],
)
def test_one_board_must_drive_every_joint(above: dict[str, str | None], why: str) -> None:
    driven = {name: {"finger": finger} if finger else {} for name, finger in above.items()}
    paces = {name: Pace(EVERY, 1, params) for name, params in driven.items()}
    board = context("hand", config("utah_mit"), every=EVERY, clock_ns=CLOCK_NS, above=paces)
    found = [misfit[2] for misfit in HandExecutor.find_mismatches(board)]
    assert found[:1] == ([why] if why else [])
    assert len(found) in (0, 4)
