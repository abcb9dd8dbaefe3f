"""The system controller at a tick: lost and restarted boards, and its demand on the arm."""

from __future__ import annotations

import os
import signal
from dataclasses import replace

import pytest

from rack.backplane.clock.driver import RealtimeDriver
from rack.backplane.mailbox.protocols import open_observer, open_writer
from rack.backplane.message import State
from rack.backplane.operator_table import (
    Client,
    OperatorTable,
    Request,
    RequestStage,
)
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, open_alarm_ring
from rack.backplane.words import Block, Demand, System, TaskState, encode_switch
from rack.boards.config.layout import build_field_specs
from rack.boards.operator import build_hold_command
from rack.boards.run.system_controller import EndOfRun, SystemController
from rack.boards.wiring import ClockWiring
from rack.levels.messages import TaskStatus
from rack.levels.operator import Operation, OperatorCommand
from tests.backplane.bus import mailbox, task
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, forked, wait_until
from tests.tools.faults.test_ending import box


def wiring(**changed: object) -> ClockWiring:
    """Return a clock's wiring in real time, without a stop."""
    plain: dict[str, object] = {
        "lockstep": False,
        "period_ns": 2_500_000,
        "stop_tick": 0,
        "ends_run": None,
        "linger": 10,
        "silent": 40,
        "longest": 0,
        "history": 100,
        "core": 0,
        "priority": 0,
        "keeps_awake": False,
        "restart_ticks": 20,
        "on_loss": {"left": Demand.STOP, "right": Demand.BRAKE},
        "reservation": None,
        "schedulings": {},
        "copy": None,
    }
    return ClockWiring(**{**plain, **changed})  # type: ignore[arg-type]  # by name, as above


class Controlled:
    """A system controller of two boards, cycled by the test."""

    def __init__(self, segment: Segment, **changed: object) -> None:
        self.words = segment.words
        self.words[System.PERIOD_NS] = 2_500_000
        self.alarms = open_alarm_ring(segment, "clock")
        self.driver = RealtimeDriver(segment, lambda tick: None, AlarmWriter(segment, "clock"))
        self.blocks = {name: segment.get_block(name) for name in ("left", "right")}
        for block in self.blocks.values():
            block[Block.STATE] = TaskState.RUNNING
        given = wiring(**changed)
        self.end_of_run = EndOfRun(segment, given)
        self.controller = SystemController(segment, given, self.driver, self.end_of_run)

    def lose(self, name: str, tick: int) -> None:
        """Lose a board, as the crate records it."""
        self.words[System.LOSSES] += 1
        self.set_lost(name, tick)
        self.words[System.LOSSES] += 1

    def set_lost(self, name: str, tick: int) -> None:
        block = self.blocks[name]
        block[Block.LOST], block[Block.STATE] = 1 + tick, TaskState.STARTING

    def demand(self, tick: int) -> Demand:
        """Return the demand on the arm after the clock's work at a tick."""
        self.controller.begin_tick(tick)
        return Demand(self.words[System.DEMAND])


BOARDS = task("left"), task("right", slot=3)


def test_the_strongest_demand_of_all_lost_boards_holds(make_bus: MakeBus) -> None:
    rack = Controlled(make_bus(*BOARDS))
    assert rack.demand(0) is Demand.NONE
    rack.lose("left", 3)
    assert rack.demand(3) is Demand.STOP
    rack.lose("right", 5)
    assert rack.demand(5) is Demand.BRAKE
    rack.blocks["right"][Block.STATE] = TaskState.READY
    assert rack.demand(7) is Demand.STOP
    rack.blocks["left"][Block.STATE] = TaskState.READY
    assert rack.demand(9) is Demand.NONE
    # Rejoined after two ticks, and after six.
    values = rack.alarms.read_new_rows().rows["value"].tolist()
    assert values == [Demand.STOP, Demand.BRAKE, 2, Demand.STOP, 6, Demand.NONE]


@pytest.mark.parametrize("is_lost_first", [False, True])
def test_a_loss_counts_from_its_tick_however_slowly_the_crate_records_it(
    make_bus: MakeBus, is_lost_first: bool
) -> None:
    rack = Controlled(make_bus(*BOARDS))
    assert rack.demand(0) is Demand.NONE
    rack.words[System.LOSSES] += 1
    if not is_lost_first:
        # Nothing is lost yet, but the controller must look again at every tick.
        assert rack.demand(1) is Demand.NONE
        assert rack.controller.find_next_work_tick(1) == 2
    rack.set_lost("left", 2)
    assert rack.demand(2) is Demand.STOP
    rack.words[System.LOSSES] += 1
    assert rack.demand(3) is Demand.STOP


def test_the_clock_follows_the_network_adapter_at_its_tick(make_bus: MakeBus) -> None:
    rack = Controlled(make_bus(*BOARDS))
    rack.words[System.PEER_STOP] = encode_switch(5, True)
    assert [rack.demand(tick) for tick in (4, 5, 6)] == [Demand.NONE, Demand.STOP, Demand.STOP]
    rack.words[System.PEER_STOP] = encode_switch(9, False)
    assert rack.demand(8) is Demand.STOP
    # A switch that lies ahead is waited for tick by tick.
    assert rack.controller.find_next_work_tick(8) == 9
    assert rack.demand(9) is Demand.NONE


@pytest.mark.filterwarnings(FORKS)
def test_a_command_whose_client_has_died_is_not_issued_and_says_so(make_bus: MakeBus) -> None:
    segment = make_bus(mailbox(name="left.operator", writer="clock"), *BOARDS)
    rack, table = Controlled(segment), OperatorTable(segment)

    def wait_for_ever() -> None:
        with table.claim_request(Request(0, b"", tick=2)):
            signal.pause()

    with forked(wait_for_ever) as client:
        wait_until(table.list_waiting)
        (entry,) = table.list_waiting()
        rack.controller.begin_tick(1)
        os.kill(client, signal.SIGKILL)
        wait_until(lambda: not table.is_client_alive(entry))
    rack.controller.begin_tick(2)
    assert entry.given_tick == -1
    assert entry.stage == RequestStage.WAITING
    assert segment.words[System.COMMANDED] == 0
    # Left out for good: the clock has no more to do with it.
    assert not table.list_waiting()


@pytest.mark.parametrize("is_released", [False, True])
@pytest.mark.parametrize("is_restarted", [False, True])
def test_a_level_holds_once_its_operator_has_gone_unless_the_lease_was_released(
    make_bus: MakeBus, is_released: bool, is_restarted: bool
) -> None:
    fields = build_field_specs(OperatorCommand.message_type, {})
    size = OperatorCommand.message_type.build_dtype({}).itemsize
    box = replace(mailbox(name="left.operator", writer="clock"), fields=fields, size=size)
    segment = make_bus(box, *BOARDS)
    rack, table = Controlled(segment), OperatorTable(segment)
    operator = open_observer(segment, "left.operator")
    goto = build_hold_command(box)
    goto.what = Operation.GOTO
    with table.claim_request(Request(0, bytes(goto.raw)), Client.LEASES) as entry:
        for tick in (1, 2, 3):
            rack.controller.begin_tick(tick)
        assert operator.peek().message.what == Operation.GOTO
        if is_restarted:
            for writer in rack.controller._desk._writers.values():
                writer.close()
            rack = Controlled(segment)
        if is_released:
            table.release_lease(entry)
    for tick in (4, 5, 6):
        rack.controller.begin_tick(tick)
    codes = rack.alarms.read_new_rows().rows["code"].tolist()
    assert codes.count(Alarm.OPERATOR_GONE) == (not is_released)
    last = Operation.GOTO if is_released else Operation.HOLD
    assert operator.peek().message.what == last
    assert not table.list_leased()


def test_a_board_given_up_sets_the_latch_and_ends_the_run_after_the_arm_has_come_to_rest(
    make_bus: MakeBus,
) -> None:
    rack = Controlled(make_bus(*BOARDS))
    rack.lose("left", 3)
    rack.blocks["left"][Block.STATE] = TaskState.GIVEN_UP
    assert rack.demand(4) is Demand.BRAKE
    assert (rack.words[System.EMERGENCY_STOP], rack.words[System.STOP_TICK]) == (1, 14)
    # A second one does not put the end off, nor does time.
    rack.lose("right", 6)
    rack.blocks["right"][Block.STATE] = TaskState.GIVEN_UP
    rack.demand(7)
    assert rack.words[System.STOP_TICK] == 14


def test_the_next_work_tick_is_the_end_of_the_run_unless_there_is_work(make_bus: MakeBus) -> None:
    status = replace(box(TaskStatus, "task.status"), every=8, delay=8)
    bus = make_bus(*BOARDS, task("task", every=8, slot=4), status)
    rack = Controlled(bus, ends_run="task.status")
    assert rack.controller.find_next_work_tick(0) == 1
    rack.demand(0)
    rack.end_of_run(3)
    assert rack.controller.find_next_work_tick(3) == 9
    rack.lose("left", 3)
    rack.demand(4)
    assert rack.controller.find_next_work_tick(4) == 5
    rack.blocks["left"][Block.STATE] = TaskState.READY
    rack.demand(5)
    assert rack.controller.find_next_work_tick(5) == 9


ENDS: dict[str, tuple[State, dict[str, int], list[int | None]]] = {
    # Visible at 6, seen at 7 as of the tick before; ten ticks of rest.
    "lingers after its task is done": (State.DONE, {}, [None] * 7 + [16] * 5),
    "lingers after its task has failed": (State.ERROR, {}, [None] * 7 + [16] * 5),
    # Heard as of tick 6; silent for 40 ticks as of 46, which is seen at 47.
    "ends once the level is silent": (State.EXECUTING, {}, [None] * 47 + [56] * 13),
    # Noticed at tick 20, which reads as of the tick before; ten ticks of rest.
    "ends after its longest time": (State.EXECUTING, {"longest": 20}, [None] * 20 + [29] * 15),
    "ends at its given length": (State.DONE, {"stop_tick": 99}, [99] * 12),
}
"""What a run does: the state that its task writes at tick 5, settings, and the end as known at each
tick."""


@pytest.mark.parametrize(("state", "settings", "ends"), ENDS.values(), ids=ENDS)
def test_a_run_ends_by_its_length_its_task_its_silence_or_its_longest_time(
    make_bus: MakeBus, state: State, settings: dict[str, int], ends: list[int | None]
) -> None:
    segment = make_bus(box(TaskStatus, "task.status"), task("task"))
    over = EndOfRun(segment, wiring(ends_run="task.status", **settings))
    found = []
    for tick in range(len(ends)):
        if tick == 5:
            writer = open_writer(segment, "task.status")
            writer.message.state = state
            writer.write(tick)
        found.append(over(tick))
    assert found == ends
