"""The claims of section 4.1, which compares the control model with other systems."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rack.tools.lab.reproduction import system_rules
from rack.tools.lab.reproduction.experiments import tasks
from rack.tools.lab.reproduction.experiments.experiment import Experiment
from rack.tools.lab.reproduction.experiments.nasrem import NAME, NASREM
from rack.tools.lab.reproduction.page import PaperClaim, Section
from rack.tools.lab.reproduction.verdict import MAX_STRAY_SHARE, ClaimVerdict


def build_system_claim(
    name: str,
    title: str,
    quote: str,
    why: str,
    rates_hz: dict[str, int],
    at_least: Mapping[str, float] | None = None,
    at_most: Mapping[str, float] | None = None,
    judge: Callable[..., ClaimVerdict] = system_rules.judge_system,
    rack: str = "",
) -> PaperClaim:
    """Build a claim about one of the paper's systems.

    The default rule counts the messages between the parts of the system, and compares the
    measurements of the mechanism that the sentence names.

    Args:
        name: Anchor of the claim.
        title: Heading.
        quote: Sentence of the paper.
        why: Reason for the ruling.
        rates_hz: Rate of each mailbox between the parts, Hz.
        at_least: Smallest permitted values of these measurements.
        at_most: Largest permitted values.
        judge: Rule of the claim.
        rack: Rack that models the system. Empty if it has the name of the claim.
    """
    return PaperClaim(
        name,
        title,
        quote,
        why,
        (tasks.TASKS[rack or name],),
        partial(judge, rates_hz, at_least or {}, at_most or {}),
    )


SYSTEMS = (NAME, tasks.STATE_TABLES, *tasks.TASKS)
"""Racks that model the paper's systems."""
TASKS_OF_SYSTEMS: tuple[Experiment[Any], ...] = (NASREM, tasks.TABLES, *tasks.TASKS.values())
"""Experiments with their whole tasks."""


SYSTEMS_SECTION = Section(
    "4.1",
    "Comparison of Concurrent Hierarchical Control to Other Models",
    (
        PaperClaim(
            "systems",
            "The systems next to each other",
            "These architectures share common characteristics with the concurrent,"
            " hierarchical control model.",
            "All systems do their tasks on one set of mechanisms, within their bounds.",
            TASKS_OF_SYSTEMS,
            partial(system_rules.judge_systems, SYSTEMS),
        ),
        PaperClaim(
            "two-levels",
            "At least two levels",
            "Most systems have at least a two-level hierarchy.",
            "Each system ran closed loops of two levels or more, none faster than one below it.",
            TASKS_OF_SYSTEMS,
            partial(system_rules.judge_layers, SYSTEMS),
        ),
        build_system_claim(
            "rccl",
            "RCCL: a queue of requests, and a processor a joint",
            "The joint control level operates at 1 kHz and assigns 1 processor per joint. ..."
            " a rough motion planner asynchronously produces a queue of motion requests.",
            "Requests waited in the queue, motions were blended, and a live goal was followed.",
            {
                "planning.plan": 1,
                "trajectory.command": 50,
                **{f"joint{number}.command": 1000 for number in range(1, 7)},
            },
            {
                "requests_queued": 2,
                "blends": 1,
                "slowest_blend_rad_s": 0.02,
                "live_goal_followed_m": 0.05,
            },
            {"live_goal_astray_m": 0.005},
            judge=system_rules.judge_rccl,
        ),
        build_system_claim(
            "hic",
            "HIC: layers of servo loops",
            "This model emphasis layers of servo loops with deterministic scheduling ... and"
            " uses periodic data buffers for communication.",
            "Every loop kept its frame and locked nothing; each got data of one age.",
            {"tendon.command": 500, "joint.command": 500, "fingertip.command": 125},
            {"frames": 1},
            {
                "locked_mailboxes": 0,
                "cycles_outside_frame_share": MAX_STRAY_SHARE,
                "ages_off_share": MAX_STRAY_SHARE,
            },
        ),
        build_system_claim(
            "condor",
            "CONDOR: boards, an adapter and a workstation",
            "... Motorola 68020 based boards connected by VME bus to VME bus adapter to a"
            " SUN-3 workstation controlling the Utah/MIT hand.",
            "The fingers of several boards gripped as the workstation had planned.",
            {"workstation.plan": 1, "index.command": 400, "thumb.command": 400},
            {"entries_in": 1, "entries_out": 1, "fingers_on_planned_grasp": 2},
        ),
        build_system_claim(
            "ibm",
            "IBM: a real-time bridge",
            "IBM extends the exchange of commands and status to include varying frequencies;"
            " such as every cycle, every nth invocation or asynchronously.",
            "The bridge passed messages in each of the three ways, and all requests ended.",
            {"bridge.requests": 1},
            {
                "entries_every_cycle": 1,
                "entries_every_nth_cycle": 1,
                "entries_asynchronous": 1,
            },
            {"requests_not_ended": 0},
        ),
        build_system_claim(
            "chimera",
            "CHIMERA: motion control and commands",
            "... low-level real-time motion control connected to a non-real-time AML/X"
            " command environment.",
            "Commands came at any time and were carried out; set points came in every cycle.",
            {"command.requests": 1},
            {"requests": 2, "entries_asynchronous": 1, "entries_every_cycle": 1},
            {
                "requests_not_ended": 0,
                # After a missed cycle the level gives none until all boards are in step.
                "cycles_without_set_point_share": 0.1,
            },
        ),
        build_system_claim(
            "penn",
            "Pennsylvania: a server of forces and motions",
            "... a robot coordinator issue force and motion commands to a real-time robot"
            " force and motion server.",
            "The tool slid along a surface with the commanded force.",
            {"coordinator.requests": 1},
            {"motion_requests": 1, "force_requests": 1, "slid_under_force_s": 1.0},
            {"force_error_share": 0.1},
        ),
        # The servo rack starts later. It and the network pass on four of five messages.
        build_system_claim(
            "brown",
            "Brown: servo systems on a network",
            "... high-speed networks connecting a real-time servo systems and general"
            " computing resources.",
            "The servo rack followed the references and modifications of the other machine.",
            {
                "planning.plan": 1,
                "trajectory.command": 50,
                "lan.reference": 40,
                "lan.joints": 40,
                "supervisor.command": 400,
            },
            at_most={"modifications_unanswered": 0, "references_lacking_share": 0.2},
        ),
    ),
)
"""Section 4.1, in the order of the page."""
