"""The claims of the paper, section by section.

Each claim consists of a sentence of the paper, the experiments that test it, a rule that derives
the ruling, and the reason for the ruling if the claim holds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rack.tools.lab.reproduction import predictions, rules
from rack.tools.lab.reproduction.experiments import (
    partition,
    replication,
    response,
    sharing,
    smoothness,
    speedup,
    switch,
    tasks,
)
from rack.tools.lab.reproduction.experiments.figures import (
    BUFFERED,
    FIG2,
    FIG3,
    FIG4,
    IN_BACKGROUND,
    IN_CYCLE,
    LONG_2,
    OVERLOAD,
    SHORT_2,
    SHORT_3,
    build_settings,
)
from rack.tools.lab.reproduction.experiments.nasrem import (
    DEADLINE,
    DETERMINISM,
    KILLS,
    NASREM,
    SENSORS,
    NasremRun,
)
from rack.tools.lab.reproduction.page import PaperClaim, Section
from rack.tools.lab.reproduction.system_claims import SYSTEMS_SECTION, build_system_claim
from rack.tools.lab.reproduction.verdict import ClaimVerdict


def _build_equation_claim(
    number: str,
    form: str,
    quote: str,
    config: str,
    settings: tuple[str, ...] = (),
    judge: Callable[[NasremRun], ClaimVerdict] | None = None,
) -> PaperClaim:
    """Build the claim that an equation holds.

    Args:
        number: Number of the equation.
        form: The equation.
        quote: Sentence of the paper.
        config: Config of a rack that violates the equation.
        settings: Changes to this config, as for `--set`.
        judge: Rule of the claim. None for `rules.judge_equation`.
    """
    return PaperClaim(
        f"equation-{number}",
        f"Equation {number}: {form}",
        quote,
        "It holds for every level, in the worst cycle too.",
        (NASREM,),
        judge or partial(rules.judge_equation, number),
        partial(predictions.predict_equation, number, config, settings),
    )


SHORT_RESPONSE = ("timing.response_ms=1000",)
"""Setting that demands a response within 1 s, too short for NASREM's four levels."""
SECTIONS = (
    Section(
        "abstract",
        "",
        (
            PaperClaim(
                "determinism",
                "Determinism is the measure",
                "Determinism, not performance, is the key element in assessing a control model.",
                "Two runs in lockstep and one in real time wrote the same messages, bit for bit.",
                (DETERMINISM,),
                rules.judge_determinism,
            ),
        ),
    ),
    Section(
        "1",
        "Introduction",
        (
            PaperClaim(
                "speedup",
                "Speedup by processors",
                "A robot controller will be characterized as a speedup-oriented multiprocessing"
                " application.",
                "Levels make more plans with each processor, and more than a sequential program.",
                (speedup.SPEEDUP,),
                rules.judge_speedup,
            ),
            PaperClaim(
                "growth",
                "Modular growth",
                "Multiprocessor systems are beneficial for many reasons, including ... modular"
                " growth.",
                "With a level more, all levels closed their loops and kept their cycles.",
                (tasks.SMALL_TABLES, tasks.TABLES),
                rules.judge_growth,
            ),
            PaperClaim(
                "flexibility",
                "Flexibility by partitioning",
                "... and flexibility for testing alternative control strategies via different"
                " partitioning.",
                "The same task was done along the same path in every partition.",
                (partition.TASKS,),
                rules.judge_flexibility,
            ),
            PaperClaim(
                "replication",
                "Reliability through replication",
                "... reliability through replication ...",
                "A standby replaced a lost servo level without a missing message or torque.",
                (replication.REPLICATION,),
                rules.judge_replication,
            ),
            PaperClaim(
                "communication",
                "The cost of communication",
                "The cost of communications must not negate the time savings obtained by parallel"
                " execution on the different processors.",
                "Communication takes less processor time than a second processor saves.",
                (NASREM, partition.PARTITION),
                rules.judge_communication,
            ),
        ),
    ),
    Section(
        "2",
        "Concurrent Hierarchical Real-Time Control",
        (
            PaperClaim(
                "figure-1",
                "Figure 1: information flow",
                "Figure 1 illustrates the information flow in the concurrent hierarchical model.",
                "Commands went down and statuses up in every cycle of every level.",
                (NASREM,),
                rules.judge_flow,
            ),
            PaperClaim(
                "virtual-control-loop",
                "The virtual control loop",
                "Virtual control ... consists of the following periodic actions: 1) inputting"
                " status and commands ..., 2) producing a goal-directed output ..., and 3)"
                " outputting an action ... and a status.",
                "All cycles of all levels ended within their bound.",
                (NASREM,),
                rules.judge_loop,
            ),
            PaperClaim(
                "locks",
                "lock; read; unlock",
                "... lock and unlock are primitives that guarantee mutual exclusion.",
                "Boards that lock every mailbox for each access kept all their cycles.",
                (sharing.CHAINS,),
                rules.judge_locks,
            ),
            PaperClaim(
                "planner-and-executor",
                "Planner and executor run at once",
                "The planner and executor can run concurrently within a level, thus insuring a"
                " predictable level response.",
                "No cycle of an executor was late while its planner computed.",
                (FIG2.experiment, FIG4.experiment),
                rules.judge_concurrency,
            ),
            PaperClaim(
                "bounded-waits",
                "A dead board or sensor does not stall the system",
                "A level awaiting a reading from a failed sensor could loop forever.",
                "Every loss was detected and over within its bounds, and the tasks were done.",
                (KILLS, SENSORS),
                rules.judge_losses,
            ),
            PaperClaim(
                "pipeline",
                "Five levels take five cycles",
                "It would take 5 control cycles for information from the top level to filter down"
                " to the bottom level in a five layer hierarchy.",
                "Every message took five cycles.",
                (sharing.CHAINS,),
                rules.judge_pipeline,
            ),
        ),
    ),
    Section(
        "3",
        "Timing Analysis",
        (
            PaperClaim(
                "soft-and-real-time",
                "GOTO A, and GOTO A BY t",
                "GOTO A BY t_i, GOTO B BY t_i+1 ... demands real time handling.",
                "A time that is too early is refused before anything moves; one that is promised"
                " is met.",
                (DEADLINE,),
                rules.judge_goto,
            ),
        ),
    ),
    Section(
        "3.1",
        "System Response Time",
        (
            _build_equation_claim(
                "3.1",
                "t_proc + t_c = R_i ≤ R_max",
                "... the ith level spends t_c seconds communicating/waiting for commands and"
                " status, and t_proc processing.",
                "fig4-overload",
            ),
            _build_equation_claim(
                "3.2",
                "R_s ≤ n R_max",
                "An upper bound to the system response time R_s can be calculated.",
                "nasrem",
                SHORT_RESPONSE,
            ),
            _build_equation_claim(
                "3.3",
                "R_s = Σ R_i + Σ R_j",
                "This leads to a definition of R_s, system response time, as the sum of R_i"
                " response times tied to the machine update rate, and the sum of R_j response"
                " times arbitrarily set.",
                "nasrem",
                SHORT_RESPONSE,
                rules.judge_sum,
            ),
        ),
    ),
    Section(
        "3.2",
        "Low-Level Timing Requirements",
        (
            _build_equation_claim(
                "3.4",
                "t_exec < R_max",
                "t_exec, the time the executor runs each cycle, is less than the level response"
                " time limit maximum.",
                "fig4-overload",
                build_settings("fig4-overload", 6.0),
            ),
            _build_equation_claim(
                "3.5",
                "R_i = t_exec + t_comm + t_residual",
                "R_i is composed of t_exec, ... t_comm, ... and t_residual, time remaining before"
                " the next cycle.",
                "fig4-overload",
            ),
            _build_equation_claim(
                "3.6",
                "0 < t_residual ≤ R_i - max t_exec - max t_comm",
                "[The residual] must be bounded by a sum of the worst case times for both"
                " processing and communication.",
                "fig4",
                build_settings("fig4", 3.0),
            ),
            PaperClaim(
                "smooth-motion",
                "Smooth motion",
                "Smooth motion results from an efficient input-compute-output cycle that maintains"
                " a small standard deviation each cycle with an upper bound ... on variance.",
                "Error, jerk and brakings grew with jitter, with overruns beyond the residual and"
                " with the cycle; overruns within the residual changed nothing.",
                (smoothness.SMOOTHNESS,),
                rules.judge_smoothness,
            ),
        ),
    ),
    Section(
        "3.3",
        "Higher-Level Timing Requirements",
        (
            PaperClaim(
                "background",
                "Background input and output",
                "Increased time at higher levels allows slower options to execute in the"
                " background, such as secondary data storage.",
                "Storing data in the background made no cycle late; storing it in the cycle does.",
                (IN_BACKGROUND.experiment, IN_CYCLE.experiment),
                rules.judge_background,
            ),
            PaperClaim(
                "loosely-coupled",
                "Loosely coupled machines above",
                "Loosely-coupled machines could conceivably link together in a distributed"
                " control system at the very highest levels.",
                "The servo rack kept its cycles, and responded as much later as the network was"
                " slower.",
                (tasks.NETWORK, tasks.SLOWER_NETWORK),
                rules.judge_loose_coupling,
            ),
            _build_equation_claim(
                "3.7",
                "t_i+1 = t_i + c",
                "Levels execute every cycle and these cycles are of fixed time c.",
                "nasrem",
                ("board.primitive.rate_hz=60",),
            ),
            PaperClaim(
                "waiting",
                "Blocking, and polling the clock",
                "The executor could busy/wait and poll on a system clock ... where the time for a"
                " context switch ... may be too large.",
                "A board that polls starts its cycles sooner.",
                (sharing.WAITS,),
                rules.judge_waits,
            ),
            _build_equation_claim(
                "3.8",
                "t_plan / d < t_residual - 2 t_cs",
                "The planner must finish any plan within d cycles.",
                "fig3",
            ),
            _build_equation_claim(
                "3.9",
                "R_i = t_exec + t_comm + t_plan+residual + 2 t_cs",
                "Including the planner on the same processor adds two extra context switches to a"
                " cycle.",
                "fig3",
                build_settings("fig3", 3.0),
            ),
            PaperClaim(
                "update",
                "The update of the plan is not preempted",
                "Mutual exclusion requires a non-preemptable multitasking scheduler to prevent"
                " preemption of the lower priority planner in its critical section.",
                "An executor released during the update of its plan waited for the end of it.",
                (FIG3.experiment,),
                rules.judge_update,
            ),
            _build_equation_claim(
                "3.10",
                "t_e,p-comm ≪ R_i",
                "The planner to executor communication is small.",
                "fig2",
                ("timing.small_share=0.1",),
            ),
            PaperClaim(
                "slices-and-buffers",
                "Time slices and double buffers",
                "... interprocessor communication ... should use a scheme that incorporates time"
                " slices or double-buffers for plan update.",
                "With either no cycle of the executor was late.",
                (FIG4.experiment, BUFFERED.experiment),
                rules.judge_concurrency,
            ),
        ),
    ),
    Section(
        "3.4",
        "Algorithm Timing Analysis",
        (
            PaperClaim(
                "figure-2",
                "Figure 2: one processor, 8 ms",
                "All the functions can run tightly-coupled on one processor in one cycle, with"
                " sufficient residual processing time.",
                "It works, as the paper says.",
                (FIG2.experiment,),
                rules.judge_working,
                partial(predictions.predict_figure, FIG2),
            ),
            PaperClaim(
                "figure-2-x",
                "Figure 2 with X from 1 to 3 ms",
                "X ... will range from 1 to 3 ms ... The planner runs at least 3 ms. each cycle"
                " which implies that after two cycles 6 ms. will have been allotted to the"
                " planner.",
                "With the longest X the two sentences exclude each other. The runs confirm it.",
                (SHORT_2.experiment, LONG_2.experiment),
                rules.judge_sweep,
                predictions.predict_sweep,
            ),
            PaperClaim(
                "figure-3",
                "Figure 3: one processor, 6 ms",
                "A 6 ms. response time allows insufficient time for planning, so that within 3"
                " cycles no updated plan exists.",
                "It fails with every X, as the paper says.",
                (FIG3.experiment, SHORT_3.experiment),
                rules.judge_failing,
                partial(predictions.predict_figure, FIG3),
            ),
            PaperClaim(
                "figure-4",
                "Figure 4: two processors, 6 ms",
                "The control level effectively meets all timing constraints with some"
                " computational waste.",
                "It works, as the paper says.",
                (FIG4.experiment,),
                rules.judge_working,
                partial(predictions.predict_figure, FIG4),
            ),
            PaperClaim(
                "figure-4-overload",
                "Figure 4 with X = 4 ms",
                "If the function X is replaced by a newer version which requires 4 ms. a cycle,"
                " then the above functional allocation across processors will not work.",
                "It fails, as the paper says.",
                (OVERLOAD.experiment,),
                rules.judge_failing,
                partial(predictions.predict_figure, OVERLOAD),
            ),
        ),
    ),
    Section(
        "4",
        "Application of Concurrent Hierarchical Control",
        (
            PaperClaim(
                "state-tables",
                "The earlier controller: executors and state tables",
                "The flow of control featured state-table transitions.",
                "The task was done with and without a disturbance, which has its own transitions.",
                (tasks.TABLES,),
                rules.judge_tables,
            ),
            PaperClaim(
                "nasrem",
                "NASREM: four levels, 400 and 50 Hz",
                "The executor [of the primitive level] runs at 50Hz ... the robot receives torque"
                " commands at updates of 400 Hz.",
                "All levels kept their rates, and no cycle was left out.",
                (NASREM,),
                rules.judge_levels,
            ),
            PaperClaim(
                "context-switch",
                "The context switch",
                "Task-switching is approximately 100 microseconds.",
                "NIST's boards can no longer be measured; this machine is faster.",
                (switch.SWITCH,),
                rules.judge_switch,
            ),
            build_system_claim(
                "host-services",
                "Services of hosts, over the adapter",
                "The hosts provide non-real-time services.",
                "Both sides worked together until the task was done.",
                {"workstation.plan": 1, "adapter.hand": 50, "adapter.world": 50},
                rack="condor",
            ),
            PaperClaim(
                "figure-5",
                "Figure 5: concurrency by cycle time",
                "Multitasking on a single processor supplies enough processing power for both the"
                " planner and executor [at higher levels].",
                "Slow levels manage with multitasking, and fast ones do not.",
                (partition.PARTITION,),
                rules.judge_figure_5,
                predictions.predict_figure_5,
            ),
        ),
    ),
    SYSTEMS_SECTION,
    Section(
        "5",
        "Conclusion",
        (
            PaperClaim(
                "predictable-response",
                "Predictable response",
                "The regulated and predictable behavior of the virtual control loop leads to"
                " timing metrics guaranteeing performance.",
                "Commands took effect at the predicted tick, in real time within equations 3.2"
                " and 3.3.",
                (response.RESPONSE,),
                rules.judge_predictable,
            ),
        ),
    ),
)
"""Sections of the page, in the order of the paper."""
