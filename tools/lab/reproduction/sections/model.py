"""Section 2 of the paper: information flow, the virtual control loop, planner and executor, bounded
waits, pipeline."""

from __future__ import annotations

import inspect
from itertools import pairwise
from textwrap import dedent

from rack.boards.config import load, rack_timing, wire
from rack.boards.faults.kind import KINDS
from rack.boards.run.control_loop import PlannerLoop, VirtualControlLoop
from rack.tools.faults.judge import Judgement
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.figures import LEVEL, PLANNER, budget_of
from rack.tools.lab.reproduction.experiments.losses import KILLS, SENSORS, LossesRun
from rack.tools.lab.reproduction.experiments.measured import LEVELS, PIPELINE, RATE_HZ
from rack.tools.lab.reproduction.experiments.nasrem import NAME, NASREM
from rack.tools.lab.reproduction.sections.equations import stolen
from rack.tools.lab.reproduction.sections.flow import between, flow_svg
from rack.tools.lab.reproduction.sections.gantt import FIG2, FIG4, MOSTLY
from rack.tools.lab.reproduction.sections.page import (
    Assessment,
    Chapter,
    Columns,
    Findings,
    Listing,
    Plate,
    Row,
    Ruling,
    Side,
    Statement,
    code,
    text,
)

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


def _flow_tested(findings: Findings) -> Assessment:
    """Compare what passed through the mailboxes between levels with what the ticks of their writers
    demand."""
    found = findings.of(NASREM)
    config = load(NAME)
    layout = wire(config)
    boxes = {box.mailbox: box for box in found.mailboxes}
    rows = []
    lacking = 0
    for upper, lower in pairwise(rack_timing(config, layout).hierarchy.chains[0]):
        for way, writer, reader in (("down", upper, lower), ("up", lower, upper)):
            names = [box.name for box in between(layout, writer, reader)]
            for box in (boxes[name] for name in names if name in boxes):
                every = f"{box.every_ms:g}"
                rows.append((way, code(box.mailbox), writer, reader, every, box.due, box.messages))
                # A run may end before the last one is written.
                if box.messages < box.due - 1:
                    lacking += box.due - box.messages
    head = ("way", "mailbox", "from", "to", "every, ms", "messages due", "messages")
    side: Side = [
        "In a run of the whole task in real time; a message that its writer skipped is missing.",
        Columns(head, rows),
    ]
    if {way for way, *_ in rows} != {"down", "up"}:
        return Assessment(side, Ruling.FAILS, "A way between two levels had no message.")
    if not lacking:
        return Assessment(
            side, Ruling.HOLDS, "Commands went down and statuses up in every cycle of every level."
        )
    why = (
        f"Commands went down and statuses up; {lacking} of"
        f" {sum(box.due for box in boxes.values())} messages were not written, because their"
        f" cycles were skipped. {stolen(found)}"
    )
    return Assessment(side, Ruling.BOUNDED, why)


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


def _loop_tested(findings: Findings) -> Assessment:
    found = findings.of(NASREM)
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
    side: Side = [
        "Phases of the loop in every executor, us of processor time, and its cycles.",
        Columns(head, rows),
    ]
    bad = sum(task.missed + task.skipped for task in found.executors.values())
    due = sum(task.cycles for task in found.executors.values())
    if not bad:
        return Assessment(
            side, Ruling.HOLDS, f"All {due} cycles of all levels ended within their bound."
        )
    if bad < MOSTLY / 10 * due:
        why = (
            f"{bad} of {due} cycles were missed or skipped; all others ended within their bound."
            f" {stolen(found)}"
        )
        return Assessment(side, Ruling.BOUNDED, why)
    return Assessment(side, Ruling.FAILS, f"{bad} of {due} cycles were missed or skipped.")


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


def _both_tested(findings: Findings) -> Assessment:
    rows = []
    late = 0
    due = 0
    for figure, coupling in ((FIG2, "tightly"), (FIG4, "loosely")):
        tasks = findings.of(figure.experiment).tasks
        executor = tasks[LEVEL]
        rows.append(
            (code(figure.label), coupling, tasks[PLANNER].jobs, executor.jobs, executor.late)
        )
        late += executor.late
        due += executor.jobs
    head = ("rack", "coupled", "plans", "executor's cycles", "of these late")
    side: Side = [Columns(head, rows)]
    if not late:
        return Assessment(
            side,
            Ruling.HOLDS,
            "No cycle of an executor was late, while a planner computed all the time.",
        )
    ruling = Ruling.BOUNDED if late < MOSTLY * due else Ruling.FAILS
    return Assessment(
        side,
        ruling,
        f"{late} of {due} cycles of executors were late while a planner computed all the time.",
    )


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


def _bounds_tested(findings: Findings) -> Assessment:
    runs = {one.name: findings.of(one) for one in (KILLS, SENSORS)}
    side: Side = [_losses(run, script) for script, run in runs.items()]
    faults = [fault for run in runs.values() for fault in run.faults]
    count = len(faults)
    late = sum(not (fault.is_within and fault.is_recovered) for fault in faults)
    unexplained = sum(run.unexplained for run in runs.values())
    undone = [script for script, run in runs.items() if not run.worked]
    if late or undone:
        why = (
            f"{late} of {count} faults were not detected, or not recovered from, within their"
            " bounds."
        )
        return Assessment(
            side, Ruling.FAILS, f"{why} Tasks not done: {', '.join(undone) or 'none'}."
        )
    why = (
        f"All {count} losses were detected within their bounds, no level stopped cycling, and both"
        f" tasks were done. Unexplained detections: {unexplained}."
    )
    return Assessment(side, Ruling.HOLDS, why)


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
        f"{code(f'rack run {NAME} --lockstep --faults {script}')}: {text(ended)}.",
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


def _pipeline(workshop: Workshop) -> Side:
    return [
        f"{LEVELS} boards at {RATE_HZ} Hz, one below the other, each passing on in every cycle what"
        " it has read. A message becomes visible at the end of the cycle in which it was written,"
        f" so that {LEVELS} levels take exactly {LEVELS} cycles, however fast the boards are."
    ]


def _pipeline_tested(findings: Findings) -> Assessment:
    found = findings.of(PIPELINE)
    rows = [
        (mode, took, found.predicted, count)
        for mode, cycles in (("lockstep", found.lockstep), ("realtime", found.realtime))
        for took, count in cycles.items()
    ]
    side: Side = [Columns(("run", "cycles taken", "predicted", "messages"), rows)]
    is_exact = set(found.lockstep) <= {found.predicted}
    late = sum(count for took, count in found.realtime.items() if took != found.predicted)
    if is_exact and not late:
        return Assessment(side, Ruling.HOLDS, f"Every message took {found.predicted} cycles.")
    if is_exact and min(found.realtime) >= found.predicted:
        why = (
            f"In lockstep every message took {found.predicted} cycles; in real time"
            f" {late} took longer, after missed cycles."
        )
        return Assessment(side, Ruling.BOUNDED, why)
    return Assessment(
        side,
        Ruling.FAILS,
        "Messages took another number of cycles, in lockstep too, or less than predicted.",
    )


CHAPTER = Chapter(
    "2",
    (
        Statement("figure-1", (NASREM,), _flow, _flow_tested),
        Statement("virtual-control-loop", (NASREM,), _loop, _loop_tested),
        Statement("planner-and-executor", (FIG2.experiment, FIG4.experiment), _both, _both_tested),
        Statement("bounded-waits", (KILLS, SENSORS), _bounds, _bounds_tested),
        Statement("pipeline", (PIPELINE,), _pipeline, _pipeline_tested),
    ),
)
