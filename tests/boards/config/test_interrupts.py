"""Protocol interrupt in a config: when messages are sent, what they cost, and which mailboxes may
have it."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.layout import Layout, MailboxSpec
from rack.boards.config import build_rack_timing, load, load_text, resolve_layout
from rack.boards.config.timing import subtract_interrupts
from rack.boards.timing.verdicts import INBOX, evaluate_rack
from tests.boards.config.mistakes import find_mistakes
from tests.boards.run.test_interrupts import BOARDS, RACK

INTERRUPT = "protocol.default=interrupt"
LOOSE = (
    "board.lower.coupling=loose",
    "board.lower.planner_slot=9",
    "board.lower.planner_core=1",
)
"""The planner does not share the core of the executor."""


def layout_of(small: Path, *settings: str) -> Layout:
    """Return the layout of the small rack under this protocol."""
    return resolve_layout(load(small, [INTERRUPT, *settings]))


def sent(box: MailboxSpec) -> tuple[int, int, int]:
    """Return when a message is sent, ns, before which tick it must be there, and when it can first
    be seen."""
    assert box.interrupt is not None
    return box.interrupt.sent_ns, box.interrupt.due, box.delay


def test_a_message_is_sent_after_the_response_of_its_writer(small: Path) -> None:
    budget = "board.upper.budget={ read_ms = 0.5, process_ms = 2.0, write_ms = 0.6 }"
    alone = "board.upper.core=1"
    layout = layout_of(small, budget, alone)
    timing = build_rack_timing(load(small, [INTERRUPT, budget, alone]), layout)
    (response,) = timing.responses
    # The handlers of 'lower' may take time from it, and it is switched to and from.
    assert response.response_ns == 3_100_000 + 200_000 + timing.compute_interrupted_ns("upper")
    assert sent(layout.find_mailbox("upper.command")) == (response.response_ns, 2, 2)
    # Without a budget after a tick, so it is served in the next one.
    assert sent(layout_of(small).find_mailbox("upper.command")) == (2_500_000, 1, 2)
    over = "board.upper.budget.process_ms=1000"
    layout = layout_of(small, over)
    assert sent(layout.find_mailbox("upper.command"))[1] == layout.find_task("upper").every


def test_a_message_costs_its_words_and_interrupts_other_boards_only(small: Path) -> None:
    layout = layout_of(small, "protocol.interrupt={ fixed_us = 10, word_us = 2.5, depth = 3 }")
    box = layout.find_mailbox("upper.command")
    command, plan = box.interrupt, layout.find_mailbox("lower.plan").interrupt
    assert command is not None
    assert plan is not None
    assert command.service_ns == 10_000 + 2_500 * (box.size // 4)
    assert (command.depth, command.slots) == (3, (layout.find_task("lower").slot,))
    # Planner and executor share a board.
    assert plan.slots == ()


def test_an_asynchronous_port_with_interrupts_is_refused() -> None:
    found = find_mistakes(RACK, "board.hub.exchange.below.asynchronous=true")
    assert "'figure0.status' has protocol interrupt; must be false" in str(found[0])


def test_interrupts_are_part_of_computing_and_of_a_plan(small: Path) -> None:
    budget = "board.lower.budget={ read_ms = 0.1, process_ms = 0.5, plan_ms = 2.0 }"
    config = load(small, [INTERRUPT, budget, *LOOSE])
    timing = build_rack_timing(config, resolve_layout(config))
    inbox = timing.inboxes["lower"]
    assert set(inbox.mailboxes) == {"upper.command", "lower.plan"}
    # It is not known when a plan comes, so all messages may come at once.
    cost = timing.compute_interrupted_ns("lower")
    assert cost == sum(source.service_ns for source in inbox.sources)
    level = timing.levels["lower"]
    assert (level.read_ns, level.execution_ns) == (100_000, 500_000 + cost)
    assert {task.name: task.cost_ns for task in timing.tasks}["lower"] == 600_000 + cost
    assert level.plan_ns == 2_000_000 + timing.compute_interrupted_ns("lower.planner")
    measured = {"lower": timing.boards["lower"].budget}
    assert measured["lower"] is not None
    # In lockstep they take no time, so nothing was measured of them.
    assert subtract_interrupts(timing, {"lower": measured["lower"]}) == measured


@pytest.mark.parametrize(("depth", "holds"), [(BOARDS - 1, True), (BOARDS - 2, False)])
def test_an_inbox_that_a_burst_overflows_fails(depth: int, holds: bool) -> None:
    config = load_text(RACK.replace('"interrupt"', f'"interrupt"\ninterrupt.depth = {depth}'))
    verdicts = evaluate_rack(build_rack_timing(config, resolve_layout(config)))
    (found,) = [verdict for verdict in verdicts if verdict.equation == INBOX]
    assert (found.subject, found.left, found.right) == ("hub", BOARDS - 1, depth)
    assert found.holds is holds
