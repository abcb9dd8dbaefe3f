"""Claims of sections 1 to 3.3 on how levels share processors and the backplane."""

from __future__ import annotations

from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.figures import (
    BEHIND,
    BUFFERED,
    FIG3,
    FIG4,
    IN_LINE,
    LEVEL,
    PLANNER,
    FigureRun,
)
from rack.tools.lab.reproduction.experiments.sharing import (
    CHAINS,
    LEVELS,
    RATE_HZ,
    WAITS,
    Chains,
    Waits,
)
from rack.tools.lab.reproduction.experiments.tasks import (
    LATER,
    LATER_MS,
    NETWORK,
    NetworkRun,
)
from rack.tools.lab.reproduction.sections.gantt import (
    MOSTLY,
    judge_both,
    ran,
    ran_all,
)
from rack.tools.lab.reproduction.sections.page import (
    DONE,
    STRAY,
    ClaimVerdict,
    Columns,
    Requirement,
    Side,
    Statement,
    ruled,
    ruled_strays,
)

EXCHANGE_MS = 40.0
"""Largest difference between two waits for an exchange: a cycle of 20 ms above, two of 10 ms on the
network."""


def judge_speedup(one: FigureRun, two: FigureRun) -> ClaimVerdict:
    """Compare the plans of the same level on one processor and on two."""
    plans = [run.tasks[PLANNER].jobs for run in (one, two)]
    return ruled(
        (Requirement("plans on two processors, and on one", plans[1], ">", plans[0]),),
        f"On two processors the level makes {plans[1] / max(plans[0], 1):.2f} times the plans.",
        needs=(Requirement("plans on one processor", plans[0], ">=", 1),),
    )


def judge_pipeline(found: Chains) -> ClaimVerdict:
    """Compare the cycles that messages took with the number of levels."""
    exact = found.lockstep.took
    real = found.realtime.took
    off = sum(exact.values()) - exact.get(LEVELS, 0)
    early = sum(count for took, count in real.items() if took < LEVELS)
    arrived = sum(real.values())
    late = arrived - early - real.get(LEVELS, 0)
    always = (
        Requirement(f"messages in lockstep that took other than {LEVELS} cycles", off, "=", 0),
        Requirement("messages in real time that took fewer", early, "=", 0),
    )
    # Every level may miss its part.
    strays = Requirement("part that took more", late / max(arrived, 1), "<=", LEVELS * STRAY)
    return ruled(
        (*always, Requirement("messages in real time that took more", late, "=", 0)),
        f"Every message took {LEVELS} cycles.",
        here=(*always, strays),
        needs=(Requirement("messages", min(arrived, sum(exact.values())), ">=", 1),),
    )


def judge_growth(found: Chains) -> ClaimVerdict:
    """Count missed cycles after boards were added: none has more to do for it."""
    grown = found.grown
    on_time = Requirement(
        "messages that took a cycle a board", grown.took.get(grown.boards, 0), ">=", 1
    )
    why = f"From {LEVELS} boards to {grown.boards}, all cycles were in time."
    return ruled_strays("cycles missed or skipped", grown.missed, grown.due, why, (on_time,))


def judge_locks(found: Chains) -> ClaimVerdict:
    """Count missed cycles of boards that lock, read and unlock as the paper's do."""
    locked = found.locked
    why = "Boards that lock every mailbox for each access kept all their cycles."
    return ruled_strays("cycles missed or skipped", locked.missed, locked.due, why)


def judge_update(found: FigureRun) -> ClaimVerdict:
    """Count updates of a plan in which the executor began, of those that its release met."""
    why = "An executor released during the update of its plan waited for the end of it."
    return ruled_strays("updates preempted", found.preempted, found.met, why)


def judge_waits(found: Waits) -> ClaimVerdict:
    """Compare how late cycles start after polling, and after blocking."""
    blocks, polls = (found.late_us[wake] for wake in ("signal", "poll"))
    return ruled(
        (
            Requirement(
                "median lateness, polling and blocking", polls["p50"], "<", blocks["p50"], "us"
            ),
        ),
        "A board that polls starts its cycles sooner: it needs no switch.",
    )


def judge_background(behind: FigureRun, in_line: FigureRun) -> ClaimVerdict:
    """Count the cycles that are late while a level stores data in the background, and compare with
    storing in the cycle."""
    cycles = behind.tasks[LEVEL]
    blocks = behind.tasks[PLANNER].jobs
    late = Requirement("in the cycle: part of cycles late", in_line.late(LEVEL), ">=", MOSTLY)
    stored = (Requirement("blocks stored in the background", blocks, ">=", 1), late)
    what = "in the background: cycles late"
    return ruled(
        (Requirement(what, cycles.late, "=", 0), *stored),
        f"The time that the executor left was enough to store {blocks} blocks, and none of its"
        f" {cycles.jobs} cycles was late for them; with a block in each cycle they are.",
        here=(Requirement(f"{what}, part of all", behind.late(LEVEL), "<=", STRAY), *stored),
    )


def judge_loose(plain: NetworkRun, later: NetworkRun) -> ClaimVerdict:
    """Compare the servo rack's cycles, and when it responds to the machine above, with a network
    and with a slower one."""
    runs = {"network": plain, f"{LATER_MS} ms slower": later}
    shares = [
        (f"{name}: part of the servo rack's cycles missed", run) for name, run in runs.items()
    ]
    answered = [run.response_ms for run in runs.values() if run.response_ms is not None]
    slower_ms = answered[-1] - answered[0] if len(answered) == len(runs) else 0.0
    always = (
        Requirement("whole tasks done", sum(run.ended == DONE for run in runs.values()), "=", 2),
        Requirement("response later by", slower_ms, ">=", LATER_MS - EXCHANGE_MS, "ms"),
        Requirement("response later by", slower_ms, "<=", LATER_MS + EXCHANGE_MS, "ms"),
    )
    return ruled(
        (*(Requirement(name, run.servo_missed, "=", 0.0) for name, run in shares), *always),
        "The servo rack kept its cycles with both; the response to the machine above is as much"
        " later as the network is slower, and the task is done.",
        here=(*(Requirement(name, run.servo_missed, "<=", STRAY) for name, run in shares), *always),
    )


def judge_replication() -> ClaimVerdict:
    """Refuse to rule: nothing here takes over the work of a board."""
    built = Requirement("boards that a replica can replace", 0, ">=", 1)
    return ruled((), "", needs=(built,))


def _chains(workshop: Workshop, found: Chains) -> Side:
    rows = [
        (name, run.boards, run.due, run.missed, took, count)
        for name, run in vars(found).items()
        for took, count in run.took.items()
    ]
    head = ("chain", "boards", "cycles", "missed or skipped", "a message took, cycles", "messages")
    return [Columns(head, rows)]


def _pipeline(workshop: Workshop) -> Side:
    return [
        f"{LEVELS} boards at {RATE_HZ} Hz, one below the other, each passing on in every cycle what"
        " it has read. A message becomes visible at the end of the cycle in which it was written,"
        f" so that {LEVELS} levels take exactly {LEVELS} cycles, however fast the boards are."
    ]


def _updates(workshop: Workshop, found: FigureRun) -> Side:
    executor = found.tasks[LEVEL]
    return [f"{found.met} updates were met by one of {executor.jobs} releases of the executor."]


def _waits(workshop: Workshop, found: Waits) -> Side:
    rows = [
        (wake, *(f"{times[part]:.1f}" for part in ("p50", "p99", "max")))
        for wake, times in found.late_us.items()
    ]
    return [Columns(("waits by", "late, median, us", "99th percentile", "longest"), rows)]


def _networks(workshop: Workshop, plain: NetworkRun, later: NetworkRun) -> Side:
    rows = []
    for later_ms, run in ((0, plain), (LATER_MS, later)):
        response = "-" if run.response_ms is None else f"{run.response_ms:.0f}"
        rows.append((later_ms, response, f"{100 * run.servo_missed:.2f}", run.ended))
    head = (
        "network slower by, ms",
        "a modification wanted above is in force after, ms",
        "missed by the servo rack, %",
        "end of the task",
    )
    return [Columns(head, rows, "Brown's two racks, in real time.")]


SPEEDUP = Statement(
    "speedup", (FIG3.experiment, FIG4.experiment), judge_speedup, measured=ran_all(FIG3, FIG4)
)
GROWTH = Statement("growth", (CHAINS,), judge_growth, measured=_chains)
REPLICATION = Statement("replication", (), judge_replication)
LOCK = Statement("locks", (CHAINS,), judge_locks, measured=_chains)
PIPELINE = Statement("pipeline", (CHAINS,), judge_pipeline, _pipeline, _chains)
UPDATE = Statement("update", (FIG3.experiment,), judge_update, measured=_updates)
WAITING = Statement("waiting", (WAITS,), judge_waits, measured=_waits)
BACKGROUND = Statement(
    "background",
    (BEHIND.experiment, IN_LINE.experiment),
    judge_background,
    measured=ran_all(BEHIND, IN_LINE),
)
LOOSE = Statement("loosely-coupled", (NETWORK, LATER), judge_loose, measured=_networks)
EXCHANGE = Statement(
    "slices-and-buffers",
    (FIG4.experiment, BUFFERED.experiment),
    judge_both,
    measured=lambda workshop, tight, buffered: ran(BUFFERED, buffered),
)
