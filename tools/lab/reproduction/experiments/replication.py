"""Loss of the servo level while the arm moves, without and with a standby.

All runs are in lockstep, so their messages differ by nothing but the loss and the standby.
"""

from __future__ import annotations

from dataclasses import dataclass

from rack.tools.console.tables import format_table
from rack.tools.lab.reproduction.experiments.experiment import ChartedRecord, Experiment, Workshop

NAME = "nasrem"
LOST_AT = 2300
"""Tick at which the servo level is killed. The arm moves along its first path."""
SECONDS = 6.5
RUN_S = 13.0
LOCKSTEP = "clock.mode=lockstep"
STANDBY = "board.servo.standby={slot=9,core=0}"
KILL = f"{{kind='kill',board='servo',tick={LOST_AT}}}"


@dataclass(frozen=True)
class LossRun:
    """One run, from `LOST_AT` on.

    Attributes:
        digest: Digest of the run.
        ticks_without_torque: Ticks without a status of the servo level, or with engaged brakes.
        brakings: Number of times that the brakes have engaged.
        messages_missing: Statuses of the servo level that were not written.
        hand_overs: Number of times that a standby has taken over.
    """

    digest: str
    ticks_without_torque: int
    brakings: int
    messages_missing: int
    hand_overs: int


@dataclass(frozen=True)
class ReplicationRun(ChartedRecord):
    """The same run without a loss, with a loss, and with a loss and a standby."""

    undisturbed: LossRun
    alone: LossRun
    replicated: LossRun


def _measure_replication(workshop: Workshop) -> ReplicationRun:
    """Run the rack three times."""
    runs = {
        "no loss": measure_loss(workshop),
        "loss": measure_loss(workshop, f"fault=[{KILL}]"),
        "loss, standby": measure_loss(workshop, f"fault=[{KILL}]", STANDBY),
    }
    rows = [[name, *map(str, vars(run).values())] for name, run in runs.items()]
    head = ["run", "digest", "ticks without torque", "brakings", "messages missing", "hand-overs"]
    return ReplicationRun(*runs.values(), chart="\n".join(format_table(head, rows)))


def measure_loss(workshop: Workshop, *settings: str) -> LossRun:
    """Run the rack with additional settings."""
    config = workshop.load_config(NAME, (LOCKSTEP, *settings))
    result, run = workshop.run("replication", config, SECONDS)
    is_late = run.read_signal("servo.status", "tick") >= LOST_AT
    braked = run.read_signal("servo.status", "braked")[is_late]
    missing = result.outcome.ticks - LOST_AT - len(braked)
    codes = [event.get("code") for event in run.events if event.get("tick", -1) >= LOST_AT]
    return LossRun(
        result.outcome.digest,
        missing + int(braked.sum()),
        codes.count("brakes_closed"),
        missing,
        codes.count("taken_over"),
    )


REPLICATION = Experiment(
    "replication",
    "the loss of the servo level without and with a standby",
    3 * RUN_S,
    ReplicationRun,
    _measure_replication,
    cores=0,
)
