"""All that a run in lockstep leaves behind, but for times: to compare runs with one another."""

from __future__ import annotations

from collections.abc import Mapping

from rack.backplane.fault_table import FAULT_WORDS, FaultTable, Stage
from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment
from rack.backplane.trace import open_trace_ring
from rack.backplane.words import Block, System
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event

OF_TASK = (
    Block.RELEASED,
    Block.DEADLINE,
    Block.DONE,
    Block.CYCLES,
    Block.MISSED,
    Block.SKIPPED,
    Block.CORRUPT,
    Block.BUS_ERRORS,
    Block.TRACE_HEAD,
    Block.LEVEL_STATE,
    Block.PLANS,
    Block.LOST,
    Block.LEVEL_SINCE,
    Block.AWAITS,
    Block.INTERRUPTS,
    Block.INTERRUPTS_LOST,
    Block.INTERRUPTS_WAITING,
    Block.CLOCK_SKIPPED,
)
OF_SYSTEM = (
    System.STATE,
    System.TICK,
    System.STOP_TICK,
    System.CLOCK_SKIPPED,
    System.FAULTS,
    System.DEMAND,
    System.INJECTED,
    System.LOSSES,
    System.SYSRESET,
    System.ACFAIL,
    System.REQUESTED,
    System.COMMANDED,
    System.HELD,
)
STRIKE = tuple(word for word in range(FAULT_WORDS) if word != 13)
BY_CHANCE = ("died", "restart", "given_up")
"""Codes of events that the Rack learns of from the kernel, at no certain tick."""
TIMELESS = ("tick", "flags", "state")


def counted(segment: Segment) -> dict[str, object]:
    """Return the counts of the tasks and of the clock, and the cycles that the trace still has."""
    layout = segment.layout
    lost = {task.slot for task in layout.tasks if segment.get_block(task.name)[Block.LOST]}
    cycles = {}
    for task in layout.tasks:
        rows = open_trace_ring(segment, task.name).read_new_rows().rows
        cycles[task.name] = {name: rows[name] for name in TIMELESS}
    return {
        "tasks": {
            task.name: [segment.get_block(task.name)[word] for word in OF_TASK]
            for task in layout.processes
        },
        "system": [segment.words[word] for word in OF_SYSTEM],
        # The replacement of a lost task releases the line at no certain tick.
        "sysfail": [slot for slot in UtilityLines(segment).sysfail if slot not in lost],
        "cycles": cycles,
    }


def whole_run(config: RackConfig, seconds: float) -> Mapping[str, object]:
    """Run a rack in lockstep; return its parts: messages, events in the order of their ticks,
    counts, cycles, faults, its end."""
    with Rack(config) as rack:
        outcome = rack.run(seconds)
        counts = counted(rack.segment)
        struck = [
            [*(entry.words[word] for word in STRIKE), *entry.parameters]
            for entry in FaultTable(rack.segment).list_entries(tuple(Stage)[1:])
        ]
        # A busy machine makes a launch wait for its boards.
        heard = [event for event in rack.events if event.kind != "waiting"]
        events = sorted({_of_event(event) for event in heard})
    end = (outcome.cause, outcome.ticks, outcome.state, outcome.reason, outcome.faults)
    return {"messages": outcome.digest, "events": events, **counts, "struck": struck, "end": end}


def _of_event(event: Event) -> tuple[object, ...]:
    """Return what of an event depends on ticks alone: of several who find the same, the Rack may
    name one."""
    tick = -1 if event.code in BY_CHANCE or event.kind == "start" else event.tick
    board = "" if event.kind == "detection" else event.board
    return (tick, event.kind, board, event.code, event.fault, event.subject, event.since)


def in_short(parts: Mapping[str, object]) -> dict[str, object]:
    """Return the parts of a whole run for a snapshot: messages, events, and all counts together."""
    apart = ("messages", "events")
    counts = {name: part for name, part in parts.items() if name not in apart}
    return {name: parts[name] for name in apart if name in parts} | {"counts": counts}
