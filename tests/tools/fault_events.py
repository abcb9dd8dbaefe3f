"""Hand-made faults and events, for tests of their judgement."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout, MailboxSpec, TaskSpec
from rack.boards.events import Event, EventKind
from rack.boards.faults.kind import KINDS
from rack.tools.faults.ending import EXTERNAL, Strike

TICK_NS = 2_500_000
TASKS = (
    TaskSpec("upper", "upper", "executor", 2, 0, 0, 8, 1, 64),
    TaskSpec("lower", "lower", "executor", 3, 0, 0, 1, 1, 64),
    TaskSpec("lower.planner", "lower", "planner", 3, 0, 0, 1, 4, 64),
)


def box(name: str, writer: str, reader: str, every: int) -> MailboxSpec:
    """Return a mailbox that shows its messages a period later."""
    return MailboxSpec(name, writer, (reader,), "time-slice", every, every, 64, "m", 1, 8, ())


LAYOUT = Layout(
    "small",
    TICK_NS,
    TASKS,
    (box("upper.command", "upper", "lower", 8), box("lower.status", "lower", "upper", 1)),
)


def event(
    tick: int, kind: EventKind, code: str, board: str = "", subject: str = "", value: float = 0.0
) -> Event:
    """Return an event in the middle of its tick."""
    return Event(tick * TICK_NS + TICK_NS // 2, tick, kind, board, code, code, -1, subject, value)


def found(tick: int, code: str, board: str, subject: str = "") -> Event:
    """Return a detection."""
    return event(tick, "detection", code, board, subject)


def flows(tick: int, mailbox: str = "lower.status") -> Event:
    """Return the recovery of a mailbox whose messages flow again."""
    return event(tick, "recovery", "flows", "clock", mailbox)


def strike(kind: str, board: str, tick: int, ends: int = -1, place: int = 0, **more: Any) -> Strike:
    """Return a fault that struck at the beginning of a tick, and is over at `ends`; once, where
    that is not said."""
    number = KINDS["kill" if kind == EXTERNAL else kind].number
    parameters = tuple(parameter.default or 0.0 for parameter in KINDS[number].parameters)
    tasks = [task.name for task in TASKS]
    made = Strike(
        fault=place,
        kind=kind,
        board=board,
        began=tick,
        ends=tick + 1 if ends < 0 else ends,
        tick=tick,
        time_ns=tick * TICK_NS,
        mailboxes=tuple(m.name for m in LAYOUT.mailboxes if m.writer == board),
        injection=Injection(
            number, tasks.index(board) if board in tasks else -1, parameters=parameters
        ),
    )
    return replace(made, **more)
