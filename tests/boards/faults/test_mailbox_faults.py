"""Mailbox faults in a whole rack: each is found by its reader, none where none is, and the run
repeats with them."""

from __future__ import annotations

from typing import Any

import pytest

from rack.backplane.layout import PROTOCOLS
from rack.backplane.words import Block, TaskState
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event, Outcome
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kind import KINDS
from tests.boards.conftest import LOOSE, MakeConfig
from tests.processes import wait_until

pytestmark = pytest.mark.thorough

KINDS_OF_WRITERS = ("mute", "drop", "delay", "reorder", "corrupt", "babble", "masquerade")


def run(
    config: RackConfig, *faults: dict[str, Any], seconds: float = 1.0
) -> tuple[Outcome, list[Event]]:
    """Run a rack with faults; return how it ended and what was detected."""
    given = config.model_copy(update={"fault": tuple(FaultConfig(**fault) for fault in faults)})
    with Rack(given) as rack:
        outcome = rack.run(seconds)
        return outcome, [event for event in rack.events if event.kind == "detection"]


def fault(kind: str, board: str, tick: int, ticks: int = 80) -> dict[str, Any]:
    """Return a fault on all that a task writes; on one mailbox where a kind wants one."""
    cycles = {} if kind == "masquerade" else {"cycles": ticks}
    return {"kind": kind, "board": board, "tick": tick, **cycles}


@pytest.mark.parametrize("kind", KINDS_OF_WRITERS)
def test_a_fault_of_an_executor_is_detected_and_the_run_repeats(
    config: MakeConfig, kind: str
) -> None:
    runs = [run(config(), fault(kind, "wave", 101)) for _ in range(2)]
    outcomes, found = zip(*runs, strict=True)
    assert outcomes[0].digest == outcomes[1].digest
    assert all(outcome.cause == "time over" for outcome in outcomes)
    for events in found:
        assert {event.subject for event in events} == {"wave.status"}
        assert {event.code for event in events} & set(KINDS[kind].codes)
        assert min(event.tick for event in events) >= 101


@pytest.mark.parametrize(
    ("kind", "coupling"),
    [*((kind, ()) for kind in KINDS_OF_WRITERS), ("delay", LOOSE), ("masquerade", LOOSE)],
)
def test_a_run_with_a_fault_of_a_planner_repeats(
    config: MakeConfig, kind: str, coupling: tuple[str, ...]
) -> None:
    runs = [run(config(*coupling), fault(kind, "wave.planner", 101)) for _ in range(2)]
    outcomes, _ = zip(*runs, strict=True)
    assert outcomes[0].digest == outcomes[1].digest
    assert all(outcome.cause == "time over" for outcome in outcomes)


@pytest.mark.parametrize("victim", ["wave", "wave.planner", "watch"])
def test_a_lost_board_raises_alarms_for_its_own_silence_alone(
    config: MakeConfig, victim: str
) -> None:
    _, found = run(config(), {"kind": "kill", "board": victim, "tick": 100})
    # Nobody reads the watch, and plans have no period.
    assert {(event.code, event.subject) for event in found} == (
        {("stale", "wave.status")} if victim == "wave" else set()
    )


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_without_a_fault_nothing_is_detected(config: MakeConfig, protocol: str) -> None:
    _, found = run(config(f"protocol.default={protocol}"))
    assert found == []


def test_the_bus_counters_continue_after_a_restart(config: MakeConfig) -> None:
    given = config().model_copy(
        update={"fault": (FaultConfig(kind="kill", board="watch", tick=804),)}
    )
    with Rack(given) as rack:
        rack.run(3.0)
        block = rack.segment.block("watch")
        wait_until(lambda: block[Block.STATE] == TaskState.ENDED)
        # Of its 101 cycles the dead process had accounted for 64: it does so in every 64th.
        accounted = block[Block.CYCLES] - 101 + 64
        assert block[Block.READS] == block[Block.WRITES] == accounted > 64


def flows(config: RackConfig, *faults: dict[str, Any]) -> list[tuple[int, str, float]]:
    """Run a rack with faults; return when messages were seen to flow again, of which mailbox, and
    after how long."""
    given = config.model_copy(update={"fault": tuple(FaultConfig(**fault) for fault in faults)})
    with Rack(given) as rack:
        rack.run(1.0)
        return [
            (event.tick, event.subject, event.value)
            for event in rack.events
            if event.code == "flows"
        ]


@pytest.mark.parametrize("kind", KINDS_OF_WRITERS)
def test_messages_are_seen_to_flow_again_after_a_fault(config: MakeConfig, kind: str) -> None:
    over = 102 if kind == "masquerade" else 181
    # The first message after it is visible a tick later, and seen at the beginning of the next.
    assert flows(config(), fault(kind, "wave", 101)) == [(over + 2, "wave.status", 2.0)]


def test_no_messages_flow_after_a_fault_without_an_end(config: MakeConfig) -> None:
    assert flows(config(), {"kind": "mute", "board": "wave", "tick": 101}) == []


def test_a_restarted_clock_sees_messages_flow_again_too(config: MakeConfig) -> None:
    kill = {"kind": "kill", "board": "clock", "tick": 182}
    ((tick, mailbox, _),) = flows(config(), fault("mute", "wave", 101), kill)
    assert (tick >= 183, mailbox) == (True, "wave.status")
