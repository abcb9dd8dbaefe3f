"""The command environment of the host side: calls become requests in the order of the calls."""

from __future__ import annotations

from collections import deque

import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import copy_message
from rack.levels.errors import LevelError, RunOver
from rack.levels.systems.trajectory.commands import Motions
from rack.levels.systems.trajectory.messages import (
    MotionKind,
    MotionRequest,
    MotionStatus,
    RequestEnd,
)
from tests.levels.arms import config, context

PUMA, SCENE = config("puma560")
SIZES = {"joints": 6}
CONTEXT = context("program", (PUMA, SCENE), sizes=SIZES)


class Level:
    """A bus, both ports of a program, and a level that carries out one request per wait.

    At most `room` messages may wait.
    """

    def __init__(self, room: int = 100, sent: int = 0) -> None:
        self.room, self.sent, self.is_over, self.tick = room, sent, False, 0
        self.time_s = 0.0
        self.queue: deque[MotionRequest] = deque()
        self.done: list[MotionRequest] = []
        self.loses: set[int] = set()
        self.status = MotionStatus.zeros(SIZES)
        self.message = MotionRequest.zeros(SIZES)

    def wait(self, timeout_s: float) -> bool:
        """Carry out the next request, or lose it."""
        self.time_s += 1.0
        if self.queue:
            request = self.queue.popleft()
            is_cancel = request.kind == MotionKind.CANCEL
            if request.id in self.loses:
                self.loses.remove(request.id)
            elif request.id == self.status.done + 1 or not self.done or is_cancel:
                self.done.append(request)
                self.status.done = self.status.taken = request.id
                self.status.ended[0], self.status.ends[0] = request.id, RequestEnd.DONE
        return True

    def read(self) -> Reading[MotionStatus]:
        return Reading(self.status, Verdict.NEW)

    def send(self) -> bool:
        if len(self.queue) >= self.room:
            return False
        self.sent += 1
        self.queue.append(copy_message(self.message))
        self.message.clear()
        return True

    def finish(self) -> None:
        """Do nothing."""


def test_calls_become_requests_in_their_order_and_wait_ends_with_the_last() -> None:
    level = Level()
    arm = Motions(level, level, level, CONTEXT)
    arm.release()
    arm.line((0.1, 0.2, 0.3), body="block2", segment=2.0)
    arm.grip(0.01, force=5.0)
    last = arm.move()
    assert (last, arm.done()) == (4, False)
    assert arm.wait()
    assert [request.id for request in level.done] == [1, 2, 3, 4]
    kinds = [MotionKind.GRIP, MotionKind.POSE, MotionKind.GRIP, MotionKind.JOINTS]
    assert [request.kind for request in level.done] == kinds
    assert (level.done[1].body, level.done[1].segment) == (SCENE.bodies.index("block2"), 2.0)
    assert tuple(level.done[3].joints) == PUMA.home
    assert arm.end_of(last) is RequestEnd.DONE
    first, last = arm.stay(0.1), arm.stay(0.1)
    # A wait ends when its condition holds.
    assert not arm.wait(until=lambda: arm.done(first))
    assert not arm.done(last)
    why = r"line: body = block9: not in the scene; its bodies are block1, "
    with pytest.raises(LevelError, match=why):
        arm.line((0.0, 0.0, 0.1), body="block9")


@pytest.mark.parametrize(("room", "loses"), [(2, ()), (100, (2,))], ids=["full", "lost"])
def test_no_request_is_left_out(room: int, loses: tuple[int, ...]) -> None:
    level = Level(room=room)
    level.loses = {*loses}
    arm = Motions(level, level, level, CONTEXT)
    for _ in range(10):
        arm.stay(0.1)
    assert arm.wait()
    assert [request.id for request in level.done] == [*range(1, 11)]


def test_a_restarted_process_cancels_first_and_uses_new_numbers() -> None:
    level = Level(sent=7)
    arm = Motions(level, level, level, CONTEXT)
    arm.stay(0.1)
    sent = [(request.id, request.kind) for request in level.queue]
    assert sent == [(8, MotionKind.CANCEL), (9, MotionKind.STAY)]


def test_a_request_that_finds_the_queue_full_at_the_end_of_the_run_is_given_up() -> None:
    level = Level(room=0)
    level.is_over = True
    with pytest.raises(RunOver, match="the run is over"):
        Motions(level, level, level, CONTEXT).move()
