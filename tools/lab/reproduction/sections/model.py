"""Section 2 of the paper: information flow, the virtual control loop, planner and executor, bounded
waits, pipeline."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from itertools import pairwise
from textwrap import dedent

from rack.boards.config import load, rack_timing, wire
from rack.boards.faults.kind import KINDS
from rack.boards.run.control_loop import PlannerLoop, VirtualControlLoop
from rack.tools.faults.judge import Judgement
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.figures import (
    FIG2,
    FIG4,
    LEVEL,
    PLANNER,
    FigureRun,
    budget_of,
)
from rack.tools.lab.reproduction.experiments.losses import KILLS, SENSORS, LossesRun
from rack.tools.lab.reproduction.experiments.nasrem import (
    NAME,
    NASREM,
    MailboxTraffic,
    NasremRun,
)
from rack.tools.lab.reproduction.sections.equations import stolen
from rack.tools.lab.reproduction.sections.flow import between, flow_svg
from rack.tools.lab.reproduction.sections.gantt import judge_both
from rack.tools.lab.reproduction.sections.page import (
    Chapter,
    ClaimVerdict,
    Columns,
    Listing,
    Plate,
    Requirement,
    Row,
    Side,
    Statement,
    code,
    ruled,
    ruled_strays,
    text,
)
from rack.tools.lab.reproduction.sections.sharing import LOCK, PIPELINE

PAPERS_LOOP = """\
procedure level()
cobegin
  repeat                           "executor section, runs at a higher priority"
    waituntil(next-cycle);         "timing synchronization primitive"
    update(next-cycle);            "update next cycle count"
    lock; read_command; unlock;    "read command"
    lock; read_status; unlock;     "read status"
    read plan;                     "read current plan"
    process;                       "execute level"
    lock; write_command; unlock;   "write command"
    lock; write_status; unlock;    "write status"
  until forever;

  repeat                           "planner"
    plan;                          "do level planning"
    lock; write_plan; unlock;      "update executor plan"
  until forever;
coend"""


def _flow(workshop: Workshop) -> Side:
    config = load(NAME)
    layout = wire(config)
    rack = rack_timing(config, layout)
    path = workshop.picture("figure1").with_suffix(".svg")
    path.write_text(flow_svg(rack, layout), encoding="utf-8")
    caption = (
        f"Drawn from the config of {code(NAME)}: levels, mailboxes and their messages, planners."
    )
    return [Plate(path.relative_to(workshop.folder), caption)]


def _passed(found: NasremRun) -> Iterator[tuple[str, str, str, MailboxTraffic]]:
    """Yield the mailboxes between two levels: the way, writer and reader, and what passed."""
    config = load(NAME)
    layout = wire(config)
    boxes = {box.mailbox: box for box in found.mailboxes}
    for upper, lower in pairwise(rack_timing(config, layout).hierarchy.chains[0]):
        for way, writer, reader in (("down", upper, lower), ("up", lower, upper)):
            for box in between(layout, writer, reader):
                if box.name in boxes:
                    yield way, writer, reader, boxes[box.name]


def _flow_measured(workshop: Workshop, found: NasremRun) -> Side:
    rows = [
        (way, code(box.mailbox), writer, reader, f"{box.every_ms:g}", box.due, box.messages)
        for way, writer, reader, box in _passed(found)
    ]
    head = ("way", "mailbox", "from", "to", "every, ms", "messages due", "messages")
    return [
        "In a run of the whole task in real time; a message that its writer skipped is missing."
        f" {stolen(found)}",
        Columns(head, rows),
    ]


def judge_flow(found: NasremRun) -> ClaimVerdict:
    """Compare the messages between levels with what the ticks of their writers demand."""
    passed = list(_passed(found))
    due = sum(box.due for *_, box in passed)
    # A run may end before the last one is written.
    lacking = sum(max(0, box.due - 1 - box.messages) for *_, box in passed)
    used = {way for way, *_, box in passed if box.messages}
    ways = Requirement("ways with messages, down and up", len(used), "=", 2)
    why = "Commands went down and statuses up in every cycle of every level."
    return ruled_strays("messages not written", lacking, due, why, (ways,))


def _loop(workshop: Workshop) -> Side:
    place = code("boards/run/control_loop.py")
    own = "\n\n".join(
        dedent(inspect.getsource(method)).rstrip()
        for method in (VirtualControlLoop.run, VirtualControlLoop.cycle)
    )
    planner = dedent(inspect.getsource(PlannerLoop.cycle)).rstrip()
    return [
        Listing(PAPERS_LOOP, "The paper's algorithm."),
        Listing(own, f"The executor section here, {code('VirtualControlLoop')} in {place}."),
        Listing(planner, f"The planner here, {code('PlannerLoop')} in the same file."),
        f"{code('cobegin')} is two processes; {code('lock')} and {code('unlock')} are inside the"
        " mailboxes, since only one of their protocols needs them. The plan is read first, as C of"
        " figure 4; the order of the reads makes no difference, as all of them come before"
        " <i>process</i>. Unlike the paper's planner, this one may find that no plan is wanted.",
    ]


def _loop_measured(workshop: Workshop, found: NasremRun) -> Side:
    head = (
        "level",
        "read plan (C): median",
        "read command and status (R): median",
        "process (X): median",
        "write (W): median",
        "longest of all parts",
        "cycles",
        "missed",
        "skipped",
    )
    rows: list[Row] = []
    for level, task in found.executors.items():
        parts = (task.phases.exchange, task.phases.read, task.phases.process, task.phases.write)
        rows.append(
            (
                level,
                *(f"{part.p50:.1f}" for part in parts),
                f"{max(part.max for part in parts):.0f}",
                task.cycles,
                task.missed,
                task.skipped,
            )
        )
    words = "Phases of the loop in every executor, us of processor time, and its cycles."
    return [f"{words} {stolen(found)}", Columns(head, rows)]


def judge_loop(found: NasremRun) -> ClaimVerdict:
    """Compare the cycles that missed their bound with all."""
    bad = sum(task.missed + task.skipped for task in found.executors.values())
    due = sum(task.cycles for task in found.executors.values())
    why = f"All {due} cycles of all levels ended within their bound."
    return ruled_strays("cycles missed or skipped", bad, due, why)


def _both(workshop: Workshop) -> Side:
    config = FIG2.loaded()
    apart = FIG4.loaded()
    cycle_ms = config.every(LEVEL) * config.clock_ns * 1e-6
    return [
        f"In {code(FIG2.config)} a plan takes {budget_of(config).plan_ms:g} ms of computing; the"
        f" executor's cycle is {cycle_ms:g} ms, and it needs part of that. The planner is therefore"
        " still computing when the next cycle begins: the executor preempts it (tightly coupled)."
        f" In {code(FIG4.config)} both compute at the same time, on processors"
        f" {apart.board[LEVEL].planner_core} and {apart.board[LEVEL].core} (loosely coupled). In"
        " neither may the executor wait for the planner."
    ]


def _both_measured(workshop: Workshop, tight: FigureRun, loose: FigureRun) -> Side:
    rows = []
    for figure, coupling, run in ((FIG2, "tightly", tight), (FIG4, "loosely", loose)):
        tasks = run.tasks
        executor = tasks[LEVEL]
        rows.append(
            (code(figure.label), coupling, tasks[PLANNER].jobs, executor.jobs, executor.late)
        )
    head = ("rack", "coupled", "plans", "executor's cycles", "of these late")
    return [Columns(head, rows)]


def _bounds(workshop: Workshop) -> Side:
    kinds = dict.fromkeys(
        fault.kind for one in (KILLS, SENSORS) for fault in load(NAME, (), one.name).fault
    )
    rows = [(code(name), text(KINDS[name].means)) for name in kinds]
    return [
        "Every wait has a bound: a level reads what is there, with its age, and never waits for a"
        " neighbour. A script of faults kills every board, the clock's too; another one makes the"
        " sensors fail. Each kind has a bound, in cycles of the board concerned, within which it"
        " must be detected.",
        Columns(("fault", "what it does"), rows),
    ]


def _bounds_measured(workshop: Workshop, kills: LossesRun, sensors: LossesRun) -> Side:
    return [_losses(kills, KILLS.name), _losses(sensors, SENSORS.name)]


def judge_bounds(*runs: LossesRun) -> ClaimVerdict:
    """Compare when each loss was detected and over with its bounds."""
    faults = [fault for run in runs for fault in run.faults]
    struck = sum(fault.struck >= 0 for fault in faults)
    late = sum(not fault.is_within for fault in faults)
    lasting = sum(not fault.is_recovered for fault in faults)
    why = (
        f"All {len(faults)} losses were detected and over within their bounds, no level stopped"
        " cycling, and the tasks were done."
    )
    return ruled(
        (
            Requirement("losses struck", struck, "=", len(faults)),
            Requirement("not detected within the bound", late, "=", 0),
            Requirement("not recovered within the bound", lasting, "=", 0),
            Requirement("tasks not done", sum(not run.worked for run in runs), "=", 0),
        ),
        why,
    )


def _losses(found: LossesRun, script: str) -> Columns:
    head = (
        "tick",
        "fault",
        "of",
        "detected by",
        "as",
        "after, ticks",
        "bound, ticks",
        "reaction",
        "recovered after, ms",
    )
    ended = f"{found.cause} after {found.ticks} ticks of {found.clock_ms:g} ms"
    return Columns(
        head,
        [_loss_row(fault, found.clock_ms) for fault in found.faults],
        f"{code(f'rack run {NAME} --faults {script}')}: {text(ended)}. Detections that no fault"
        f" explains: {found.unexplained}.",
    )


def _loss_row(fault: Judgement, clock_ms: float) -> Row:
    recovery = None if fault.recovery is None else f"{fault.recovery * clock_ms:g}"
    return (
        fault.struck,
        fault.kind,
        text(f"{fault.board} {fault.joint}".strip()),
        text(fault.found_by),
        text(fault.found_as),
        fault.delay,
        fault.bound,
        text(", ".join(fault.reactions)) or "none needed",
        recovery,
    )


CHAPTER = Chapter(
    "2",
    (
        Statement("figure-1", (NASREM,), judge_flow, _flow, _flow_measured),
        Statement("virtual-control-loop", (NASREM,), judge_loop, _loop, _loop_measured),
        LOCK,
        Statement(
            "planner-and-executor",
            (FIG2.experiment, FIG4.experiment),
            judge_both,
            _both,
            _both_measured,
        ),
        Statement("bounded-waits", (KILLS, SENSORS), judge_bounds, _bounds, _bounds_measured),
        PIPELINE,
    ),
)
