"""The primitive level as a state table, without a rack: conditions, motions and set points."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message
from rack.boards.config import load
from rack.boards.config.resolved import resolve
from rack.levels.level import LevelContext
from rack.levels.systems.joint_boards.messages import ArmStatus, JointReference, JointStatus
from rack.levels.systems.state_table.primitive import JointMove, JointMoveStatus, PrimitiveTable

BOARDS = ("first", "second")


@pytest.fixture(scope="module")
def context() -> LevelContext:
    PrimitiveTable.preload()
    plan = resolve(load("nist-state-table"))
    return next(wiring.context for wiring in plan.tasks if wiring.task == "primitive")


class Bench:
    """The level with messages that the test fills. The arm is initially where it is commanded."""

    def __init__(self, context: LevelContext) -> None:
        self.context = context
        self.level = PrimitiveTable(context)
        self.home = self.level._point[0].copy()
        self.arm = ArmStatus.zeros(self.context.sizes)
        self.arm.opening = self.level._gripper.open
        self.below = [JointStatus.zeros(self.context.sizes) for _ in BOARDS]
        self.readings = [Reading(below, Verdict.NEW) for below in self.below]
        for below in self.below:
            below.position = self.home
        self.above: dict[str, Reading] = {}
        self.tick = 10 * context.every

    def command(self, joints: np.ndarray, speed: float = 1.0, row: int = -1) -> None:
        """Set the command of the level above from now on."""
        command = JointMove.zeros(self.context.sizes)
        command.joints, command.speed, command.object = joints, speed, row
        self.above = {"move": Reading(command, Verdict.NEW)}

    def look(self) -> dict[str, str]:
        vars(self.level).update(
            above=self.above,
            statuses=dict(zip(BOARDS, self.readings, strict=True)),
            arm=Reading(self.arm, Verdict.NEW),
        )
        return self.level.evaluate_conditions(self.tick)

    def give(self) -> Message:
        """Write the set point, move the arm there, and return the set point."""
        self.level.write_outputs(self.tick)
        command = self.level.command
        for below in self.below:
            below.position = command.position
        self.tick += self.context.every
        assert isinstance(command, Message)
        return command

    def follow(self) -> None:
        """Run a cycle in which the boards below follow."""
        self.look()
        self.give()


@pytest.fixture
def bench(context: LevelContext) -> Bench:
    return Bench(context)


def test_a_motion_leads_straight_from_rest_to_rest(bench: Bench) -> None:
    bench.follow()
    # A motion to the present position never begins.
    bench.command(bench.home)
    bench.look()
    bench.level.do_begin()
    assert bench.level._curve is None
    goal = bench.home + 0.1
    bench.command(goal, speed=0.5)
    assert bench.look()["arm"] == "arrived"
    bench.level.do_begin()
    first = bench.give()
    # The first set point is a cycle into the motion.
    step = first.position - bench.home
    assert (step > 0).all()
    assert (step < 0.1).all()
    arms = []
    positions = [first.position.copy()]
    while not arms or arms[-1] == "moving":
        arms.append(bench.look()["arm"])
        assert len(arms) < 10_000
        positions.append(bench.give().position.copy())
        assert bench.level.status.moving == (arms[-1] == "moving")
    assert arms[-1] == "arrived"
    np.testing.assert_allclose(positions[-1], goal, atol=1e-9)
    assert (bench.level.command.velocity == 0).all()
    moved = np.array(positions) - bench.home
    np.testing.assert_allclose(moved, moved[:, :1] * np.ones(len(goal)), atol=1e-9)
    assert (np.diff(moved[:, 0]) >= -1e-12).all()
    np.testing.assert_array_equal(bench.level.status.end, goal)


def test_half_the_speed_takes_longer_and_a_speed_is_at_most_the_limit(bench: Bench) -> None:
    bench.follow()
    ends = {}
    for speed in (0.0, 0.01, 0.5, 1.0, 3.0):
        bench.level._curve = None
        bench.command(bench.home + 0.5, speed)
        bench.look()
        bench.level.do_begin()
        assert bench.level._curve is not None
        ends[speed] = bench.level._curve.ends_s
    assert ends[0.0] == ends[0.01] > ends[0.5] > ends[1.0] == ends[3.0]
    # A goal beyond a joint's limits is cut.
    bench.level._curve = None
    bench.command(np.full(len(bench.home), 100.0))
    bench.look()
    bench.level.do_begin()
    np.testing.assert_array_equal(bench.level._end, bench.level._limits.position[:, 1])


@pytest.mark.parametrize("action", ["do_halt", "do_begin"])
def test_a_motion_that_is_halted_comes_to_rest_elsewhere(bench: Bench, action: str) -> None:
    bench.follow()
    bench.command(bench.home + 0.5)
    bench.look()
    bench.level.do_begin()
    for _ in range(10):
        bench.give()
        bench.look()
    before = bench.level.command.position.copy()
    getattr(bench.level, action)()
    cycles = 0
    while (arm := bench.look()["arm"]) == "moving":
        bench.give()
        cycles += 1
        assert cycles < 10_000
    assert arm == "resting"
    last = bench.give().position
    assert (last > before).all()
    assert (last < bench.home + 0.4).all()
    # A halt at rest has no effect.
    bench.level.do_halt()
    assert bench.level._curve is None


def test_the_arm_is_away_while_a_board_below_is_stopped_or_lost(bench: Bench) -> None:
    bench.follow()
    bench.below[1].stopped = 1
    bench.below[1].reason = "brakes"
    assert bench.look()["arm"] == "away"
    assert bench.level.detail == "brakes"
    bench.below[1].stopped = 0
    bench.below[1].reason = ""
    # It continues from where the arm is.
    bench.below[0].position = bench.home + 0.2
    assert bench.look()["arm"] == "resting"
    np.testing.assert_allclose(bench.give().position, bench.home + 0.2)
    assert bench.level.detail == ""
    for bad in ({"is_lost": True}, {"verdict": Verdict.NONE}):
        good = bench.readings[0]
        bench.readings[0] = good._replace(**bad)
        assert bench.look()["arm"] == "away"
        assert bench.level.detail == "its board is lost"
        bench.readings[0] = good
        assert bench.look()["arm"] != "away"


@pytest.mark.parametrize(
    ("is_closed", "off", "speed", "expected"),
    [
        (False, -0.0009, 0.0, "open"),
        (False, -0.0011, 0.0, "moving"),
        (True, 0.0009, 0.0, "empty"),
        (True, 0.0011, 0.0, "holds"),
        (True, 0.0011, -0.0021, "moving"),
        (True, 0.0, 0.0019, "empty"),
        (False, 0.0, 0.0021, "moving"),
    ],
)
def test_a_gripper_that_cannot_close_completely_holds_something(
    bench: Bench, is_closed: bool, off: float, speed: float, expected: str
) -> None:
    gripper = bench.level._gripper
    bench.level._closed = is_closed
    bench.arm.opening = (gripper.closed if is_closed else gripper.open) + off
    bench.arm.opening_velocity = speed
    assert bench.look()["gripper"] == expected


def test_a_restarted_board_restores_its_gripper_and_its_set_point(bench: Bench) -> None:
    last = JointMoveStatus.zeros(bench.context.sizes)
    last.closed = last.held = last.object = 1
    last.table = bench.level.table_name
    last.in_state = bench.level.state
    last.position = bench.home + 0.1
    last.end = bench.home + 0.2
    command = JointReference.zeros(bench.context.sizes)
    command.id = 77
    level = bench.level
    vars(level).update(
        last_status=Reading(last, Verdict.NEW), last_command=Reading(command, Verdict.NEW)
    )
    level.restore_state()
    assert (level._closed, level._held, level._held_row) == (True, True, 1)
    np.testing.assert_allclose(level._point[0], bench.home + 0.1)
    np.testing.assert_allclose(level._end, bench.home + 0.2)
    assert level.command.id == 77
