"""The trajectory level as seen by its neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.words import Demand
from rack.levels.messages import Error
from rack.levels.operator import Answer, Operation
from rack.levels.systems.trajectory.messages import MotionKind, RequestEnd
from tests.levels.systems.trajectory.rig import EVERY, PERIOD_S, TrajectoryRig

JOINTS, POSE = MotionKind.JOINTS, MotionKind.POSE
DOWN = (0.0, 0.0, 1.0, 0.0)
POST = 3  # row of a body that moves


class TrackingRig(TrajectoryRig):
    """A rig with a body that moves along y after the first second."""

    def __init__(self, speed: float = 0.1) -> None:
        super().__init__()
        self.speed, self.at = speed, 1.0
        self.tool = self.cycle().tool.copy()
        self.track()

    def track(self) -> None:
        """Place the body as sensed now."""
        now_s = self.tick * 1e-3
        moved = [0.0, self.speed * max(now_s - self.at, 0.0), -0.1]
        self.world.position[POST] = np.add(self.tool, moved)
        self.world.velocity[POST] = [0.0, self.speed * (now_s >= self.at), 0.0]
        self.world.sensed = self.tick

    def follow(self, seconds: float) -> None:
        """Run while the body moves."""
        for _ in range(round(seconds / PERIOD_S)):
            self.track()
            self.cycle()


def test_the_tool_keeps_up_with_a_body_that_moves() -> None:
    rig = TrackingRig()
    rig.request(MotionKind.POSE, position=(0, 0, 0.1), quaternion=DOWN, body=POST, live=1)
    rig.request(MotionKind.STAY, segment=3.0)
    rig.joints([0] * 6)
    rig.follow(3.5)
    status = rig.written["status"]
    assert status.current == 2
    assert 0.0 < status.astray < 1e-3
    # The set point is due two cycles later, therefore the tool leads the body.
    ahead_s = (rig.tick + EVERY) * 1e-3 - rig.at
    assert np.allclose(status.tool - rig.tool, [0, rig.speed * ahead_s, 0], atol=1e-3)
    rig.follow(4.0)
    assert max(rig.excess()) <= 1.0
    assert rig.ends() == {1: RequestEnd.DONE, 2: RequestEnd.DONE, 3: RequestEnd.DONE}


@pytest.mark.parametrize("waits", ["boards that hold", "an operator", "a required stop"])
def test_a_request_fails_after_its_waits_unless_somebody_stops_the_arm(waits: str) -> None:
    rig = TrajectoryRig(stalled=0.4)
    waiting = rig.joints([0.3, 0, 0, 0, 0, 0], segment=5.0)
    rig.joints([0] * 6)
    rig.run(0.2)
    if waits == "an operator":
        rig.say(Operation.HOLD)
    elif waits == "a required stop":
        rig.level.demand = Demand.STOP
    # The boards hold again and again, each time for less than the limit.
    for _ in range(8):
        for board in rig.statuses.values():
            board.stopped = waits != "an operator"
        rig.run(0.1)
        for board in rig.statuses.values():
            board.stopped = False
        status = rig.run(0.1)
    if waits == "boards that hold":
        why = "waiting for joints0: it does not follow set points"
        assert status.reason == f"request {waiting}: waited for 0.4 s: {why}"
        assert status.error == Error.STALLED
        assert rig.ends() == {waiting: RequestEnd.FAILED, waiting + 1: RequestEnd.CANCELLED}
    else:
        assert not status.error


def test_after_an_error_new_requests_are_refused_until_a_cancel() -> None:
    rig = TrajectoryRig()
    tool = rig.cycle().tool.copy()
    rig.joints([0.3, 0, 0, 0, 0, 0])
    wrong = rig.request(MotionKind.POSE, position=np.add(tool, [0, 0, -3.0]), quaternion=DOWN)
    dropped = rig.joints([0] * 6)
    rig.run(3.0)
    late = rig.joints([0] * 6)
    status = rig.run(0.1)
    assert status.state == State.ERROR
    assert f"request {wrong}: no joint positions" in status.reason
    assert status.resting
    ends = rig.ends()
    assert (ends[1], ends[dropped]) == (RequestEnd.DONE, RequestEnd.CANCELLED)
    assert ends[wrong] == ends[late] == RequestEnd.REFUSED
    rig.request(MotionKind.CANCEL)
    again = rig.joints([0] * 6)
    status = rig.run(3.0)
    assert status.state == State.DONE
    assert rig.ends()[again] == RequestEnd.DONE
    assert not status.reason


@pytest.mark.parametrize(
    ("kind", "fields", "why"),
    [
        (JOINTS, {"joints": [9.0] * 6}, "joint 1 to 9 rad; permitted: -2.788 to 2.788"),
        (JOINTS, {"joints": [np.nan] * 6}, "joint 1 to nan rad"),
        (POSE, {"position": [np.nan] * 3}, "the pose is not finite"),
        (POSE, {"position": [0.5] * 3, "body": 7}, "body 7 is not in the world model"),
        (MotionKind.STAY, {"segment": -1.0}, "times 0 and -1 s"),
        (9, {}, "kind 9; permitted: 1 to 5"),
    ],
)
def test_an_impossible_request_is_refused_in_one_line(kind: int, fields: dict, why: str) -> None:
    rig = TrajectoryRig()
    rig.request(kind, **fields)
    status = rig.run(0.2)
    assert status.reason.startswith(f"request 1: {why}")
    assert rig.ends() == {1: RequestEnd.REFUSED}
    assert status.resting


def test_a_restarted_level_neither_repeats_nor_loses_a_request() -> None:
    rig = TrajectoryRig()
    rig.joints([0.5, 0, 0, 0, 0, 0])
    rig.joints([0.5, 0.3, 0, 0, 0, 0])
    rig.request(MotionKind.STAY, segment=0.5)
    rig.joints([0.2, 0, 0, 0, 0, 0])
    rig.run(2.0)
    before, current = rig.written["status"].done, rig.written["status"].current
    rig.restart()
    rig.run(0.3)
    assert (rig.written["status"].done, rig.written["status"].current) == (before, current)
    for _ in range(2):
        rig.run(1.7)
        rig.restart()
    status = rig.run(8.0)
    assert status.state == State.DONE
    assert rig.ends() == dict.fromkeys((1, 2, 3, 4), RequestEnd.DONE)
    assert np.allclose(rig.positions[-1] - rig.cell.home, [0.2, 0, 0, 0, 0, 0], atol=1e-9)


def test_a_lost_request_is_missing_until_it_is_sent_again() -> None:
    rig = TrajectoryRig()
    for part in (0.1, 0.2, 0.3):
        rig.joints([part, 0, 0, 0, 0, 0])
    lost = rig.queue.pop(1)
    later = rig.queue[-1]
    status = rig.run(3.0)
    assert (status.taken, status.done, status.state) == (1, 1, State.HOLDING)
    assert status.reason == "request 2 is missing: send all again from there, or a cancel"
    # Requests that were sent twice are carried out once.
    rig.queue += [lost, lost, later]
    status = rig.run(4.0)
    assert (status.taken, status.done, status.state) == (3, 3, State.DONE)


def test_the_level_waits_for_every_board_and_continues_from_where_the_arm_is() -> None:
    rig = TrajectoryRig()
    rig.joints([0.5, 0, 0, 0, 0, 0])
    rig.run(1.0)
    rig.lost.add("joints1")
    status = rig.run(0.2)
    assert (rig.written["command"].due, status.state) == (0, State.HOLDING)
    assert status.reason.startswith("waiting for joints1: no status for")
    rig.lost.clear()
    rig.brake()
    rig.run(1.0)
    name, stopped = next(iter(rig.statuses.items()))
    stopped.stopped, stopped.reason = 1, "brakes engaged"
    status = rig.run(0.3)
    assert rig.written["command"].due == 0
    assert status.state == State.HOLDING
    assert status.reason == f"waiting for {name}: brakes engaged"
    stopped.target[0] += 0.02  # the arm sags
    stopped.stopped, stopped.reason = 0, ""

    rig.cycle()
    rig.cycle()
    assert abs(rig.written["command"].position[0] - stopped.target[0]) < 1e-3
    status = rig.run(4.0)
    assert status.state == State.DONE
    assert np.allclose(rig.positions[-1][0] - rig.cell.home[0], 0.5, atol=1e-9)


def test_an_operator_holds_and_resumes() -> None:
    rig = TrajectoryRig()
    rig.joints([0.5, 0, 0, 0, 0, 0])
    rig.run(1.0)
    rig.say(Operation.HOLD)
    status = rig.run(1.5)
    assert status.resting
    assert status.state == State.HOLDING
    assert "held by the operator" in status.reason
    assert status.answer == Answer.DONE
    assert rig.written["command"].operator == rig.order.id
    where = rig.positions[-1].copy()
    rig.run(0.5)
    assert np.array_equal(rig.positions[-1], where)
    assert 0.0 < status.progress < 1.0
    rig.say(Operation.RESUME)
    assert rig.run(4.0).state == State.DONE
    assert max(rig.excess()) <= 1.0


def test_set_points_are_due_two_cycles_later_with_the_load_of_the_motion() -> None:
    rig = TrajectoryRig()
    rig.joints([0.5, 0.5, 0, 0, 0, 0])
    rig.run(1.0)
    command = rig.written["command"]
    assert command.due == rig.tick + EVERY
    terms = rig.level._dynamics.terms(command.position, command.velocity)
    assert np.array_equal(command.load, terms.bias)
    assert np.array_equal(command.inertia, terms.inertia.diagonal())
    assert np.abs(command.velocity).max() > 0.1


def test_a_body_that_outruns_the_arm_fails_the_request_and_the_arm_ramps_to_rest() -> None:
    rig = TrackingRig(speed=1.2)
    rig.at = 3.0
    rig.request(MotionKind.POSE, position=(0, 0, 0.1), quaternion=DOWN, body=POST, live=1)
    rig.request(MotionKind.STAY, segment=9.0)
    rig.follow(6.0)
    status = rig.written["status"]
    assert status.state == State.ERROR
    assert rig.ends()[2] == RequestEnd.FAILED
    assert "request 2: " in status.reason
    assert status.resting
    speed, acceleration = rig.excess()
    assert speed <= 1.05
    assert acceleration <= 1.1
