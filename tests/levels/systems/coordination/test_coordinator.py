"""The coordinator's task level: the test plays both arms."""

from __future__ import annotations

from typing import Any

from rack.backplane.message import Message, State
from rack.levels.messages import Error
from rack.levels.operator import Goal, Operation
from rack.levels.systems.coordination.coordinator import CellProgram, Coordinator
from rack.levels.systems.coordination.messages import CellReport, OrderAction, OrderVerb, Response
from tests.levels.arms import config
from tests.levels.lockstep import BoardSpec, Lockstep, Operator

EVERY = 100
ARMS = {"puma": "lan.puma", "k1607": "lan.k1607"}
PLACE = {"object": "part", "to": [0.5, 0.3, 0.475], "yaw": 0.5}
TRANSFER = {"arm": "puma", "do": "transfer", **PLACE, "by": 20.0}
REACH = {"arm": "k1607", "do": "goto", "position": [0.8, 0.5, 0.2], "by": 15.0}
BENT = {"arm": "k1607", "do": "goto", "joints": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]}
AWAY = {"arm": "puma", "do": "home"}


class CellBench(Lockstep):
    """The coordinator alone; arms that are told to answer do so at once."""

    def __init__(self, *steps: list[dict[str, Any]], **params: Any) -> None:
        board = BoardSpec("cell", EVERY, Coordinator, params={"arms": ARMS, **params})
        task = {"step": [{"do": step} for step in steps]}
        outside = dict.fromkeys(ARMS.values(), CellReport)
        super().__init__([board], *config("puma560"), task, outside=outside)
        self.checksum = CellProgram.model_validate(task).checksum

    def cycles(self, count: int = 1) -> None:
        """Run the coordinator's next cycles, until what it writes is visible."""
        for _ in range(count * EVERY + 1):
            self.step()

    def say(self, arm: str, response: Response = Response.NONE, **said: Any) -> None:
        """Have an arm answer the order that it is given, or only report."""
        order = self.order(arm)
        answer = {"echo": order.id, "program": order.program, "response": response}
        self.show(ARMS[arm], **({"state": State.EXECUTING} | answer | said))

    def both(self, response: Response) -> None:
        """Have both arms answer alike, and be read."""
        for arm in ARMS:
            self.say(arm, response)
        self.cycles(2)

    def order(self, arm: str) -> Message:
        return self.read(f"cell.order_{arm}")

    def verbs(self) -> tuple[int, int]:
        return self.order("puma").what, self.order("k1607").what

    @property
    def status(self) -> Message:
        return self.read("cell.status")


def test_step_goes_to_all_its_arms_together_and_the_next_one_after_all_are_done() -> None:
    bench = CellBench([TRANSFER, REACH], [BENT])
    bench.both(Response.NONE)
    assert bench.verbs() == (OrderVerb.ASK, OrderVerb.ASK)
    bench.say("k1607", Response.POSSIBLE, until=14.0)
    bench.cycles(2)
    assert bench.verbs() == (OrderVerb.ASK, OrderVerb.ASK)
    bench.say("puma", Response.POSSIBLE)
    bench.cycles(2)
    assert bench.verbs() == (OrderVerb.DO, OrderVerb.DO)
    bench.say("k1607", Response.DONE, moves_done=1, moves=1)
    bench.say("puma", Response.DOING, moves_done=3, moves=8)
    bench.cycles(2)
    assert (bench.status.action, bench.status.moves_done, bench.status.moves) == (0, 4, 9)
    bench.say("puma", Response.DONE, moves_done=8, moves=8)
    bench.cycles(2)
    assert bench.verbs() == (OrderVerb.NONE, OrderVerb.ASK)
    assert (bench.status.action, bench.status.moves_done, bench.status.moves) == (1, 9, 9)
    bench.say("k1607", Response.POSSIBLE)
    bench.cycles(2)
    bench.say("k1607", Response.DONE)
    bench.cycles(2)
    assert bench.verbs() == (OrderVerb.END, OrderVerb.END)
    assert bench.status.state == State.EXECUTING
    bench.both(Response.ENDED)
    assert (bench.status.state, bench.status.action) == (State.DONE, 2)


def test_orders_contain_the_actions_of_the_program() -> None:
    bench = CellBench([TRANSFER, REACH], [BENT, AWAY])
    bench.both(Response.NONE)
    puma, k1607 = bench.order("puma"), bench.order("k1607")
    assert (puma.action, puma.object, puma.yaw) == (OrderAction.TRANSFER, "part", 0.5)
    assert (k1607.goal, k1607.direction.tolist()) == (Goal.DIRECTION, [0.0, 0.0, -1.0])
    assert puma.id == k1607.id == 1000
    bench.both(Response.POSSIBLE)
    bench.both(Response.DONE)
    puma, k1607 = bench.order("puma"), bench.order("k1607")
    assert (puma.action, puma.object, puma.by) == (OrderAction.HOME, "", 0.0)
    assert (k1607.goal, k1607.joints[: k1607.count].tolist()) == (Goal.JOINTS, BENT["joints"])


def test_times_of_the_program_count_from_when_every_arm_reports() -> None:
    bench = CellBench([TRANSFER, REACH])
    bench.say("puma")
    bench.cycles(40)
    bench.both(Response.NONE)
    begun = bench.read("cell.progress").begun
    assert 10.0 < begun <= bench.seconds
    assert [bench.order(arm).by for arm in ARMS] == [20.0 + begun, 15.0 + begun]
    bench.restart("cell")
    bench.cycles(5)
    assert [bench.order(arm).by for arm in ARMS] == [20.0 + begun, 15.0 + begun]


def test_refusal_of_one_arm_ends_the_program_for_all_with_its_reason() -> None:
    bench = CellBench([TRANSFER, REACH])
    bench.both(Response.NONE)
    bench.say("puma", Response.POSSIBLE)
    why = "out of reach: [0.800, 0.500, 0.200]"
    bench.say("k1607", Response.REFUSED, error=Error.UNREACHABLE, reason=why)
    bench.cycles(2)
    reason = f"step 0 refused: k1607: {why}"
    assert bench.verbs() == (OrderVerb.END, OrderVerb.END)
    assert bench.order("puma").reason == bench.status.reason == reason
    assert bench.status.state == State.HOLDING
    bench.both(Response.ENDED)
    assert (bench.status.state, bench.status.error) == (State.ERROR, Error.UNREACHABLE)
    assert bench.status.reason == reason


def test_arm_that_is_lost_holds_the_others_and_the_program() -> None:
    bench = CellBench([TRANSFER, REACH])
    bench.both(Response.NONE)
    bench.both(Response.POSSIBLE)
    bench.boxes["lan.k1607"].lost = True
    bench.cycles(2)
    why = "k1607 is lost: the program waits until it is back"
    assert (bench.status.state, bench.status.reason) == (State.HOLDING, why)
    order = bench.order("puma")
    assert (order.what, order.hold, order.reason) == (OrderVerb.DO, 1, why)
    bench.boxes["lan.k1607"].lost = False
    bench.cycles(2)
    assert (bench.order("puma").hold, bench.status.state) == (0, State.EXECUTING)
    waits = {"state": State.HOLDING, "reason": "servo brakes engaged", "operated": 1}
    bench.say("k1607", Response.DOING, **waits)
    bench.cycles(2)
    assert bench.status.reason == "k1607: servo brakes engaged"
    operator = Operator(bench)
    operator.say("cell", Operation.HOLD)
    bench.cycles(2)
    assert (bench.status.state, bench.order("puma").hold) == (State.HOLDING, 1)
    operator.say("cell", Operation.RESUME)
    bench.cycles(2)
    assert bench.order("puma").hold == 0


def test_restarted_board_continues_its_program() -> None:
    bench = CellBench([TRANSFER, REACH], [BENT])
    bench.both(Response.NONE)
    bench.both(Response.POSSIBLE)
    bench.say("puma", Response.DONE, moves_done=8, moves=8)
    bench.say("k1607", Response.DONE, moves_done=1, moves=1)
    bench.cycles(2)
    bench.restart("cell")
    bench.cycles(2)
    assert bench.verbs() == (OrderVerb.NONE, OrderVerb.ASK)
    assert (bench.order("k1607").id, bench.status.moves) == (2000, 9)
