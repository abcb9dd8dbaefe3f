"""Section 2 of the paper: information flow, the virtual control loop, planner and executor, bounded
waits, pipeline."""

from __future__ import annotations

import inspect
from collections import Counter
from itertools import pairwise
from textwrap import dedent

from rack.boards.config import load, rack_timing, wire
from rack.boards.faults.kind import KINDS
from rack.boards.run.control_loop import PlannerLoop, VirtualControlLoop
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.figures import LEVEL, PLANNER
from rack.tools.lab.reproduction.experiments.losses import KILLS, SENSORS, LossesRun
from rack.tools.lab.reproduction.experiments.measured import LEVELS, PIPELINE, RATE_HZ
from rack.tools.lab.reproduction.experiments.nasrem import NAME, NASREM, PHASES, MailboxTraffic
from rack.tools.lab.reproduction.sections.equations import stolen
from rack.tools.lab.reproduction.sections.flow import between, flow_svg
from rack.tools.lab.reproduction.sections.gantt import FIG2, FIG4, MOSTLY, budget_of
from rack.tools.lab.reproduction.sections.page import (
    Assessment,
    Columns,
    Listing,
    Plate,
    Ruling,
    Side,
    code,
    text,
)
from rack.tools.lab.reproduction.sections.statement import Chapter, Findings, Statement

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
LETTERS = dict(
    zip(
        PHASES,
        ("read plan (C)", "read command and status (R)", "process (X)", "write (W)"),
        strict=True,
    )
)


def _flow(workshop: Workshop) -> Side:
    config = load(NAME)
    layout = wire(config)
    rack = rack_timing(config, layout)
    path = workshop.picture("figure1").with_suffix(".svg")
    path.write_text(flow_svg(rack, layout), encoding="utf-8")
    caption = (
        f"Drawn from the config of {code(NAME)}: levels, mailboxes and their messages, planners."
    )
    return Side.of(Plate(path.relative_to(workshop.folder), caption))


def _flow_tested(findings: Findings) -> Assessment:
    """Compare what passed through the mailboxes between levels with what the ticks of their writers
    demand."""
    found = findings.of(NASREM)
    config = load(NAME)
    levels = rack_timing(config, wire(config)).hierarchy.chains[0]
    boxes = {box.mailbox: box for box in found.mailboxes}
    rows = []
    short = []
    for upper, lower in pairwise(levels):
        flow = between(wire(config), upper, lower)
        for way, found_boxes in (("down", flow.down), ("up", flow.up)):
            for box in (boxes[one.name] for one in found_boxes if one.name in boxes):
                rows.append(_flow_row(way, upper, lower, box))
                short += [box] if box.messages < box.due - 1 else []
    ways = Counter(row[0] for row in rows)
    table = Columns(("way", "mailbox", "from", "to", "every, ms", "messages due", "messages"), rows)
    side = Side.of(
        "In a run of the whole task in real time; a message that its writer skipped is missing.",
        table,
    )
    if not ways["down"] or not ways["up"]:
        return Assessment(side, Ruling.FAILS, "A way between two levels had no message.")
    if not short:
        return Assessment(
            side, Ruling.HOLDS, "Commands went down and statuses up in every cycle of every level."
        )
    lacking = sum(box.due - box.messages for box in short)
    why = (
        f"Commands went down and statuses up; {lacking} of"
        f" {sum(box.due for box in boxes.values())} messages were not written, because their"
        f" cycles were skipped. {stolen(found)}"
    )
    return Assessment(side, Ruling.BOUNDED, why)


def _flow_row(way: str, upper: str, lower: str, box: MailboxTraffic) -> tuple[str, ...]:
    ends = (upper, lower) if way == "down" else (lower, upper)
    return (
        way,
        code(box.mailbox),
        *ends,
        f"{box.every_ms:g}",
        str(box.due),
        str(box.messages),
    )


def _loop(workshop: Workshop) -> Side:
    place = code("boards/run/control_loop.py")
    own = "\n\n".join(
        dedent(inspect.getsource(method)).rstrip()
        for method in (VirtualControlLoop.run, VirtualControlLoop.cycle)
    )
    planner = dedent(inspect.getsource(PlannerLoop.cycle)).rstrip()
    return Side.of(
        Listing(PAPERS_LOOP, "The paper's algorithm."),
        Listing(own, f"The executor section here, {code('VirtualControlLoop')} in {place}."),
        Listing(planner, f"The planner here, {code('PlannerLoop')} in the same file."),
        f"{code('cobegin')} is two processes; {code('lock')} and {code('unlock')} are inside the"
        " mailboxes, since only one of their protocols needs them. The plan is read first, as C of"
        " figure 4; the order of the reads makes no difference, as all of them come before"
        " <i>process</i>. Unlike the paper's planner, this one may find that no plan is wanted.",
    )


def _loop_tested(findings: Findings) -> Assessment:
    found = findings.of(NASREM)
    head = [
        "level",
        *(f"{words}: median" for words in LETTERS.values()),
        "longest of all parts",
        "cycles",
        "missed",
        "skipped",
    ]
    rows = []
    for level, parts in found.phases.items():
        task = found.tasks[level]
        longest = max(part["max"] for part in parts.values())
        medians = [f"{parts[name]['p50']:.1f}" for name in LETTERS]
        rows.append(
            (
                level,
                *medians,
                f"{longest:.0f}",
                str(task.cycles),
                str(task.missed),
                str(task.skipped),
            )
        )
    side = Side.of(
        "Phases of the loop in every executor, us of processor time, and its cycles.",
        Columns(head, rows),
    )
    executors = [found.tasks[level] for level in found.phases]
    bad = sum(task.missed + task.skipped for task in executors)
    due = sum(task.cycles for task in executors)
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
    plan = (budget_of(config).plan_ms, config.every(LEVEL) * config.clock_ns * 1e-6)
    return Side.of(
        f"In {code(FIG2.config)} a plan takes {plan[0]:g} ms of computing; the executor's cycle is"
        f" {plan[1]:g} ms, and it needs part of that. The planner is therefore still computing when"
        " the next cycle begins: the executor preempts it (tightly coupled). In"
        f" {code(FIG4.config)} both compute at the same time, on processors"
        f" {apart.board[LEVEL].planner_core} and {apart.board[LEVEL].core} (loosely coupled). In"
        " neither may the executor wait for the planner."
    )


def _both_tested(findings: Findings) -> Assessment:
    rows = []
    late = 0
    due = 0
    for figure, coupling in ((FIG2, "tightly"), (FIG4, "loosely")):
        tasks = findings.of(figure.experiment()).tasks
        executor = tasks[LEVEL]
        planner = tasks[PLANNER]
        rows.append(
            (
                code(figure.label),
                coupling,
                *(str(n) for n in (planner.jobs, executor.jobs, executor.late)),
            )
        )
        late = late + executor.late
        due = due + executor.jobs
    side = Side.of(
        Columns(("rack", "coupled", "plans", "executor's cycles", "of these late"), rows)
    )
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
    return Side.of(
        "Every wait has a bound: a level reads what is there, with its age, and never waits for a"
        " neighbour. A script of faults kills every board, the clock's too; another one makes the"
        " sensors fail. Each kind has a bound, in cycles of the board concerned, within which it"
        " must be detected.",
        Columns(("fault", "what it does"), rows),
    )


def _bounds_tested(findings: Findings) -> Assessment:
    items = []
    count = 0
    late = 0
    unexplained = 0
    undone = []
    for experiment in (KILLS, SENSORS):
        found = findings.of(experiment)
        items.append(_losses(found, experiment.name))
        count += len(found.faults)
        late += sum(not (one.is_within and one.is_recovered) for one in found.faults)
        unexplained += found.unexplained
        undone += [] if found.worked else [experiment.name]
    side = Side.of(*items)
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
    rows = [
        (
            str(one.struck),
            one.kind,
            text(" ".join(filter(None, (one.board, one.joint)))),
            text(one.found_by),
            text(one.found_as),
            str(one.delay),
            "-" if one.bound is None else str(one.bound),
            text(", ".join(one.reactions)) or "none needed",
            "-" if one.recovery_ms is None else f"{one.recovery_ms:g}",
        )
        for one in found.faults
    ]
    ended = f"{found.cause} after {found.ticks} ticks of {found.clock_ms:g} ms"
    return Columns(
        head,
        rows,
        f"{code(f'rack run {NAME} --lockstep --faults {script}')}: {text(ended)}.",
    )


def _pipeline(workshop: Workshop) -> Side:
    return Side.of(
        f"{LEVELS} boards at {RATE_HZ} Hz, one below the other, each passing on in every cycle what"
        " it has read. A message becomes visible at the end of the cycle in which it was written,"
        f" so that {LEVELS} levels take exactly {LEVELS} cycles, however fast the boards are."
    )


def _pipeline_tested(findings: Findings) -> Assessment:
    found = findings.of(PIPELINE)
    rows = [
        (mode, str(took), str(found.predicted), str(count))
        for mode, cycles in found.cycles.items()
        for took, count in cycles.items()
    ]
    side = Side.of(Columns(("run", "cycles taken", "predicted", "messages"), rows))
    others = {
        mode: sum(n for took, n in c.items() if took != found.predicted)
        for mode, c in found.cycles.items()
    }
    if not any(others.values()):
        return Assessment(side, Ruling.HOLDS, f"Every message took {found.predicted} cycles.")
    if not others["lockstep"] and all(
        took >= found.predicted for c in found.cycles.values() for took in c
    ):
        why = (
            f"In lockstep every message took {found.predicted} cycles; in real time"
            f" {others['realtime']} took longer, after missed cycles."
        )
        return Assessment(side, Ruling.BOUNDED, why)
    return Assessment(
        side,
        Ruling.FAILS,
        "Messages took another number of cycles, in lockstep too, or less than predicted.",
    )


CHAPTER = Chapter(
    name="2",
    title="Concurrent Hierarchical Real-Time Control",
    intro=(
        "A task is split into levels; each is a virtual control loop of its own, and all run at"
        " once. Within a level a planner looks ahead, and an executor keeps the cycle."
    ),
    statements=(
        Statement(
            name="figure-1",
            title="Figure 1: information flow",
            quote=(
                "Concurrent hierarchical control [is defined] as communicating layers of virtual"
                " control loops. Figure 1 illustrates the information flow in the concurrent"
                " hierarchical model."
            ),
            experiments=(NASREM,),
            predicted=_flow,
            tested=_flow_tested,
        ),
        Statement(
            name="virtual-control-loop",
            title="The virtual control loop",
            quote=(
                "Virtual control ... consists of the following periodic actions: 1) inputting"
                " status and commands from adjoining levels, 2) producing a goal-directed output"
                " based on the status and command, and 3) outputting an action to the adjoining"
                " lower level and a status to the adjoining upper level."
            ),
            experiments=(NASREM,),
            predicted=_loop,
            tested=_loop_tested,
        ),
        Statement(
            name="planner-and-executor",
            title="Planner and executor run at once",
            quote=(
                "The executor must run periodically to guarantee the cyclic behavior of the virtual"
                " control loop. The planner and executor can run concurrently within a level, thus"
                " insuring a predictable level response."
            ),
            experiments=(FIG2.experiment(), FIG4.experiment()),
            predicted=_both,
            tested=_both_tested,
        ),
        Statement(
            name="bounded-waits",
            title="A dead board or sensor does not stall the system",
            quote=(
                "Should one level be unable to complete the virtual control loop within one cycle,"
                " system performance is no longer predictable. For example, a level awaiting a"
                " reading from a failed sensor could loop forever."
            ),
            experiments=(KILLS, SENSORS),
            predicted=_bounds,
            tested=_bounds_tested,
        ),
        Statement(
            name="pipeline",
            title="Five levels take five cycles",
            quote=(
                "It would take 5 control cycles for information from the top level to filter down"
                " to the bottom level in a five layer hierarchy. However, this cyclic protocol will"
                " guarantee a deterministic system response time."
            ),
            experiments=(PIPELINE,),
            predicted=_pipeline,
            tested=_pipeline_tested,
        ),
    ),
)
