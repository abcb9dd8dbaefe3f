"""A bus adapter on a backplane without processes: what crosses it in which cycle, and what it
counts."""

from __future__ import annotations

import pytest

from rack.backplane.message import State
from rack.backplane.semaphores import get_wake_semaphore
from rack.backplane.watch.alarms import AlarmWriter
from rack.backplane.words import Block, System, TaskState
from rack.boards.host.entries import NEVER, EntryConfig, ReplayedEntry
from rack.boards.run.ports import InputPorts, OutputPorts
from tests.bare_level import BareLevel
from tests.boards.host.conftest import EVERY, OpenBus, Site, connected
from tests.boards.host_programs import Host

NEWEST = ("board.bridge.params.pass.numbers.asynchronous=false",)


@pytest.mark.parametrize("site", [("board.bridge.params.pass.numbers.most=3",)], indirect=True)
def test_each_message_passes_once_and_in_order_up_to_the_limit_of_a_cycle(
    site: Site, program: Host
) -> None:
    assert [program.send_number(float(k)) for k in range(1, 6)] == [True] * 5
    assert program.numbers.sent == 5
    site.cycle()
    assert site.count("numbers") == {"passed": 3, "waiting": 2}
    site.segment.words[System.TICK] = 6
    site.cycle()
    # Written at tick 0, passed in the cycle of tick 4.
    assert site.count("numbers") == {"passed": 5, "arrived": 4, "age": 4}
    site.cycle()
    assert site.count("numbers") == {"passed": 5, "arrived": 4, "age": 8}


@pytest.mark.parametrize("site", [NEWEST], indirect=True)
def test_only_the_newest_of_sampled_messages_passes(site: Site, program: Host) -> None:
    for k in range(1, 4):
        assert program.send_number(float(k))
    site.cycle()
    assert (site.crossed(), site.count("numbers")) == ([3.0], {"passed": 1, "superseded": 2})
    site.cycle()
    assert site.count("numbers") == {"passed": 1, "superseded": 2, "age": EVERY}


@pytest.mark.parametrize("site", [(), NEWEST], indirect=True)
def test_invalid_values_are_refused_and_counted(site: Site, program: Host) -> None:
    site.cycle()
    assert program.send_number(float("nan"))
    site.cycle()
    nothing_yet = {"arrived": NEVER, "age": NEVER}
    assert site.count("numbers") == {"refused": 1} | nothing_yet
    assert not any(site.crossed())


def test_a_full_ring_refuses_messages_and_the_bridge_counts_them(site: Site, program: Host) -> None:
    capacity = site.segment.layout.find_mailbox("program.numbers").capacity
    assert [program.numbers.send() for _ in range(capacity + 2)] == [True] * capacity + [False] * 2
    site.cycle()
    assert site.count("numbers")["full"] == 2


def test_messages_do_not_pass_before_the_computing_time_is_over(site: Site, program: Host) -> None:
    assert program.send_number(1.0)
    site.host[Block.DEADLINE] = EVERY
    site.cycle()
    assert site.count("numbers") == {"waiting": 1, "arrived": NEVER, "age": NEVER}
    site.cycle()
    assert site.count("numbers") == {"passed": 1, "arrived": EVERY, "age": EVERY}


@pytest.mark.parametrize("site", [NEWEST], indirect=True)
def test_a_restarted_bridge_continues_its_counters_and_repeats_its_messages(
    site: Site, program: Host
) -> None:
    for value in (1.0, 2.0, float("nan")):
        program.send_number(value)
    site.cycle()
    before = site.count("numbers")
    assert before == {"passed": 1, "refused": 1, "superseded": 1}
    site.restart()
    program.send_number(float("nan"))
    site.cycle()
    assert site.crossed() == [2.0]
    assert site.count("numbers") == before | {"refused": 2, "age": EVERY}
    site.restart()
    for value in (3.0, 4.0):
        program.send_number(value)
    site.cycle()
    assert site.crossed() == [4.0]
    assert site.count("numbers") == {
        "passed": 2,
        "refused": 2,
        "superseded": 2,
        "arrived": 2 * EVERY,
        "age": 2 * EVERY,
    }


def test_a_message_for_a_program_wakes_it_once(site: Site, open_bus: OpenBus) -> None:
    bus = open_bus(site)
    program = connected(bus, site)
    semaphore = get_wake_semaphore(site.segment, "program")
    site.cycle()
    assert (semaphore.value, site.count("sum")) == (0, {"arrived": NEVER, "age": NEVER})
    adder, alarms = BareLevel(), AlarmWriter(site.segment, "adder")
    inputs = InputPorts(site.segment, adder, {}, alarms)
    outputs = OutputPorts(site.segment, adder, {"status": "adder.status"}, alarms, inputs)
    adder.ports["status"].sum = 2.5
    assert outputs.write(1, None)
    site.host[Block.WAITS_UNTIL] = 50
    for _ in range(2):
        site.cycle()
        assert semaphore.value == 1
        assert site.host[Block.WAITS_UNTIL] == 0
    # A sample crosses in each cycle; it was written at tick 1.
    assert site.count("sum") == {"passed": 2, "arrived": 8, "age": 7}
    assert bus.wait(0.0)
    assert program.sum.read().message.sum == 2.5
    assert not bus.wait(0.0)


STATES = [
    (TaskState.RUNNING, 0, State.EXECUTING, ""),
    (TaskState.RUNNING, 7, State.HOLDING, "host board 'program' is lost: it is being restarted"),
    (TaskState.GIVEN_UP, 0, State.ERROR, "host board 'program' was given up"),
    (TaskState.GIVEN_UP, 7, State.HOLDING, "host board 'program' is lost: it is being restarted"),
    (TaskState.ENDED, 0, State.DONE, ""),
]


@pytest.mark.parametrize(("state", "lost", "expected", "reason"), STATES)
def test_the_status_of_a_bridge_reports_its_programs(
    site: Site, state: TaskState, lost: int, expected: State, reason: str
) -> None:
    site.host[Block.STATE] = state
    site.host[Block.LOST] = lost
    site.cycle()
    status = site.status
    assert (status.state, status.error, status.reason) == (expected, 0, reason)
    site.host[Block.STATE] = TaskState.RUNNING
    site.host[Block.LOST] = 0
    site.cycle()
    assert (site.status.state, site.status.reason) == (State.EXECUTING, "")


@pytest.mark.parametrize(("every", "phase", "due"), [(1, 0, [0, 1, 2, 3]), (3, 1, [1])])
def test_an_entry_is_due_in_its_cycles(every: int, phase: int, due: list[int]) -> None:
    entry = EntryConfig.model_validate({"from": "a.b", "every": every, "phase": phase})
    assert [cycle for cycle in range(4) if entry.is_due(cycle)] == due


class Out:
    """A port that notes what is sent."""

    def __init__(self) -> None:
        self.raw = bytearray(1)
        self.message = self
        self.sent: list[tuple[int, int]] = []

    def send(self, basis: int) -> None:
        self.sent.append((self.raw[0], basis))


@pytest.mark.parametrize(
    ("is_sent", "since", "expected"),
    [
        (True, NEVER, [[(1, 0)], [(1, 0), (2, 3), (3, 7)], [(1, 0), (2, 3), (3, 7)]]),
        (True, 4, [[], [(3, 7)], [(3, 7)]]),
        (False, 4, [1, 3, 3]),
    ],
)
def test_a_replay_writes_the_recorded_messages_at_their_ticks(
    is_sent: bool, since: int, expected: list[object]
) -> None:
    rows = [(0, 0, b"\1"), (4, 3, b"\2"), (8, 7, b"\3"), (12, 11, b"\4")]
    replayed = ReplayedEntry(rows, "port", is_sent, since)
    out = Out()
    seen: list[object] = []
    for tick in (3, 8, 11):
        replayed.exchange_messages({}, {"port": out}, tick)
        seen.append(list(out.sent) if is_sent else out.raw[0])
    assert seen == expected
