"""Resolution of a config: `resolve` checks it as a whole and wires its boards.

`rack.boards.config.loader` reads the config first. At a launch the crate can therefore import the
levels while this process resolves the config.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

from rack.backplane.address_map import CLOCK_STANDBY
from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout
from rack.backplane.operator_table import Request
from rack.backplane.words import Demand
from rack.boards.config.cell import compute_cell_sizes
from rack.boards.config.command import CommandConfig
from rack.boards.config.commands import build_requests, find_command_mistakes
from rack.boards.config.connections import TaskPorts, Wiring
from rack.boards.config.injections import build_injections, find_fault_mistakes, list_faults
from rack.boards.config.layout import RETAINED_S, LayoutBuilder, build_exchanges, find_core
from rack.boards.config.published import PublishedRack, gather_facts
from rack.boards.config.rules import apply_rules, load_network_rules
from rack.boards.config.rules.levels import check_memory, check_neighbours, check_sizes
from rack.boards.config.schedulers import (
    build_clock_scheduling,
    build_scheduling,
    compute_clock_reservation,
)
from rack.boards.config.schema import LAN, RackConfig
from rack.boards.config.timing import is_critical
from rack.boards.config.toml import find_table_name, remove_tables
from rack.boards.errors import ConfigError, Mistake
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kind import KINDS
from rack.boards.wiring import (
    BusTimes,
    ClockWiring,
    HostWiring,
    RecordedEntries,
    TaskWiring,
    list_mailboxes,
)
from rack.levels.level import LevelContext, Pace
from rack.levels.tables import GoalConfig, RobotConfig

LINGER_S = 0.5
"""Simulated time, in s, that a run continues after its task ends, so that the arm comes to rest."""
SILENT_S = 30.0
"""Simulated time, in s, for which the level that ends the run may write no status.

After this time, but at least 8 cycles of that level, the run is ended.
"""
AHEAD_S = RETAINED_S / 2
"""Simulated time, in s, by which lockstep may be ahead of a recorder: half of what rings retain."""
LAYOUT_NEEDS = {"clock", "protocol", "robot", "scene", "task"}
"""Tables that a layout depends on. If one has mistakes, no layout is computed."""


def resolve(config: RackConfig) -> Resolved:
    """Check a config completely and derive the records for a run on this machine.

    Raises:
        ConfigError: The config has mistakes. All of them are listed, including mistakes in the
            certificate files of this machine.
    """
    network = load_network_rules(config)
    further = () if network is None else network.check_credentials(config)
    return _examine(config, further).build_resolved_rack()


def resolve_layout(config: RackConfig) -> Layout:
    """Check a config, except for its certificate files, and return its layout.

    The config may thus come from another machine.

    Raises:
        ConfigError: The config has mistakes. All of them are listed.
    """
    return _examine(config).build_resolved_rack().layout


@dataclass(frozen=True)
class Resolved:
    """A checked config and the records that a launch derives from it.

    Attributes:
        config: The config.
        layout: Layout of the segment.
        tasks: Wiring of each task, in the order of the config.
        hosts: Wiring of each host board.
        faults: Entries of the fault table for the config's own faults.
        commands: Requests for the config's own operator commands.
        published: Facts about the levels, for tools.
        goals: Goals of objects, keyed by the index of the object in the scene.
    """

    config: RackConfig
    layout: Layout
    tasks: tuple[TaskWiring, ...]
    hosts: tuple[HostWiring, ...]
    faults: tuple[Injection, ...]
    commands: tuple[Request, ...]
    published: PublishedRack
    goals: Mapping[int, GoalConfig]

    def for_run(self, repeats: str, entries: Mapping[str, RecordedEntries] | None) -> Resolved:
        """Return a copy with the settings of one run.

        Args:
            repeats: Name of the recorded rack whose run is repeated. Levels see it as the name of
                their rack, because messages may contain it. Empty for the rack's own name.
            entries: For a replay, the messages that each adapter wrote in the recorded run, keyed
                by task. A replay starts no host boards and contacts no other racks. None for an
                ordinary run.
        """
        tasks = tuple(
            replace(
                task,
                context=replace(task.context, rack=repeats or self.config.name),
                entries=None if entries is None else entries.get(task.task),
            )
            for task in self.tasks
        )
        return replace(self, tasks=tasks, hosts=self.hosts if entries is None else ())

    def build_clock_wiring(self, seconds: float | None) -> ClockWiring:
        """Return the wiring of the clock's board.

        Args:
            seconds: Simulated time in s after which the run stops. None to run until the task ends.
        """
        config = self.config
        clock = config.clock
        ends_run = self.ends_run
        to_ticks = self.layout.to_ticks
        silent = to_ticks(SILENT_S)
        if ends_run is not None:
            writer = self.layout.find_mailbox(ends_run).writer
            silent = max(silent, 8 * self.layout.find_task(writer).every)
        executors = [task for task in self.layout.tasks if task.role == "executor"]
        core = self.clock_cores[0]
        # In lockstep the clock shares the core of the fastest board, because a context switch is
        # faster than waking up another core. A polling board never yields its core.
        if config.is_lockstep and (yielding := [t for t in executors if t.wake != "poll"]):
            core = min(yielding, key=lambda task: (task.every, task.slot)).core
        # The clock requires no stop of the arm if the level below a lost board holds without being
        # told.
        demands = {"hold": Demand.NONE, "stop": Demand.STOP, "brake": Demand.BRAKE}
        return ClockWiring(
            lockstep=config.is_lockstep,
            period_ns=config.tick_ns,
            stop_tick=0 if seconds is None else max(1, to_ticks(seconds)),
            ends_run=ends_run,
            linger=to_ticks(LINGER_S),
            silent=silent,
            longest=to_ticks(config.supervision.lockstep_end_s) * config.is_lockstep,
            history=to_ticks(AHEAD_S),
            core=core,
            priority=clock.priority,
            keeps_awake=not config.is_lockstep and clock.idle_cores == "awake",
            reservation=compute_clock_reservation(config),
            schedulings={t.task: t.scheduling for t in self.tasks if t.scheduling is not None}
            | build_clock_scheduling(config),
            copy=None if clock.standby is None else 0,
            restart_ticks=max(1, to_ticks(config.supervision.lockstep_restart_s)),
            on_loss={task.name: demands[config.board[task.board].on_loss] for task in executors},
        )

    def build_clock_standbys(self, wiring: ClockWiring) -> Mapping[str, ClockWiring]:
        """Return the wiring of the clock's standby by its name. Empty if the clock has none.

        Args:
            wiring: Wiring of the clock.
        """
        standby = self.config.clock.standby
        if standby is None:
            return {}
        priority = wiring.priority if standby.priority is None else standby.priority
        return {CLOCK_STANDBY: replace(wiring, core=self.clock_cores[1], priority=priority, copy=1)}

    @cached_property
    def clock_cores(self) -> tuple[int, ...]:
        """Cores of the clock and of its standby.

        They are found once, because cores that the rack gets to itself are no longer available to
        this process.
        """
        places = self.config.clock, self.config.clock.standby
        return tuple(find_core(place.core) for place in places if place is not None)

    @property
    def ends_run(self) -> str | None:
        """Name of the status mailbox whose state can end the run. None if no level ends the run."""
        return next(
            (f"{name}.status" for name, board in self.config.board.items() if board.ends_run), None
        )

    @property
    def crate_priority(self) -> int:
        """SCHED_FIFO priority of the crate: below all real-time boards, above other processes."""
        priorities = [t.priority for t in self.layout.tasks if t.priority and t.role == "executor"]
        return max(min(priorities, default=0) - 1, 0)


def _examine(config: RackConfig, further: Iterable[Mistake] = ()) -> Examination:
    """Check a config and return the examination.

    Raises `ConfigError` with all mistakes, including those in `further`, which were found earlier.
    """
    commands = [(f"command[{at}]", command) for at, command in enumerate(config.command)]
    examination = Examination(config, list_faults(config), commands)
    if mistakes := [*examination.mistakes, *further]:
        raise ConfigError(mistakes)
    return examination


class Examination:
    """Checks a whole config and derives the records that a launch needs.

    Args:
        config: The config, without broken tables.
        faults: Faults to check, each preceded by its place, as in "fault[0]".
        commands: Operator commands to check, each preceded by its place, as in "command[0]".
        broken: Tables that were removed because of known mistakes, as in "board.servo". Nothing
            that depends on them is checked.

    Attributes:
        mistakes: Every mistake found.
    """

    def __init__(
        self,
        config: RackConfig,
        faults: Iterable[tuple[str, FaultConfig]],
        commands: Iterable[tuple[str, CommandConfig]],
        broken: frozenset[str] = frozenset(),
    ) -> None:
        self._config = config
        self._wiring = Wiring(config, broken)
        self._sizes: dict[str, int] = {}
        self._layout: Layout | None = None
        self.mistakes = apply_rules(self._wiring)
        # The layout, and the checks that need it, include only the boards without mistakes.
        wrong = broken.union(find_table_name(mistake.place) for mistake in self.mistakes)
        wiring = self._wiring if not wrong else Wiring(_remove_broken_boards(config, wrong), wrong)
        if wiring.tasks and not wrong & LAYOUT_NEEDS:
            self._sizes = compute_cell_sizes(config)
            self.mistakes += (unknown_sizes := [*check_sizes(wiring, self._sizes)])
            if not unknown_sizes:
                builder = LayoutBuilder(wiring, self._sizes)
                self._layout = builder.build_layout() if self.mistakes else builder.settle_sending()
                self._contexts = self._build_board_contexts(wiring)
                self.mistakes += check_memory(self._layout)
                self.mistakes += check_neighbours(wiring, self._contexts)
        self._published = gather_facts(config)
        levels = self._published.levels
        self.mistakes += find_fault_mistakes(
            faults, config, levels, self._layout, wiring.unknown_boards
        )
        self.mistakes += find_command_mistakes(commands, config, levels, self._wiring.broken_boards)
        if (network := load_network_rules(config)) is not None:
            self.mistakes = [network.move_to_adapter(mistake, config) for mistake in self.mistakes]

    def build_resolved_rack(self) -> Resolved:
        """Derive all records that a launch needs. Call this only if there are no mistakes."""
        config = self._config
        layout = self._layout
        assert layout is not None, "no mistakes"
        faults = build_injections(config, layout)
        failing = {
            layout.tasks[fault.task].name for fault in faults if KINDS[fault.kind].where == "start"
        }
        tasks = tuple(
            self._build_task_wiring(layout, ports, ports.task in failing)
            for ports in self._wiring.tasks
        )
        wirings = {task.task: task for task in tasks}
        tasks += tuple(
            replace(
                wirings[place.board],
                task=place.name,
                guards_clock=False,
                fails_self_test=place.name in failing,
            )
            for place in config.list_standbys()
        )
        hosts = tuple(
            HostWiring(
                board=(name := ports.place.board),
                target=ports.place.target,
                inputs=dict(ports.sources),
                outputs=ports.writes,
                context=self._build_context(
                    name, config.host[name].params, every=1, within_cycles=1
                ),
                is_external=config.host[name].external,
                computing=round(config.host[name].computing_ms * 1e6 / config.clock_ns),
            )
            for ports in self._wiring.hosts
        )
        # A goal in the config replaces the program's goal for the same object.
        rows = config.scene.objects.index
        programs = [program.model_validate(config.task) for program in self._wiring.programs]
        goals = [goal for program in programs for goal in program.list_goals()]
        goal_by_row = {rows(goal.object): goal for goal in (*goals, *config.scene.goal)}
        commands = build_requests(config, layout)
        return Resolved(
            config, layout, tasks, hosts, faults, commands, self._published, goal_by_row
        )

    def _build_task_wiring(
        self, layout: Layout, ports: TaskPorts, fails_self_test: bool
    ) -> TaskWiring:
        """Return the wiring of a task, whose self-test fails if `fails_self_test` is set."""
        board = self._config.board[ports.place.board]
        spec = layout.find_task(ports.task)
        is_executor = spec.role == "executor"
        # A bus adapter reads and writes the mailboxes of the host side without ports.
        of_host = self._wiring.host_side_mailboxes
        from_host = self._wiring.mailboxes_from_host
        is_locked = not is_executor and is_critical(self._config, layout, spec.board)
        return TaskWiring(
            task=ports.task,
            target=ports.place.target,
            inputs={
                port: source
                for port, source in ports.reads.items()
                if not from_host.intersection(list_mailboxes(source))
            },
            outputs={port: box for port, box in ports.writes.items() if box not in of_host},
            context=self._contexts[spec.board],
            critical_priority=board.priority if is_locked else 0,
            sent=tuple(port for port, output in ports.outputs.items() if output.queued),
            guards_clock=is_executor and spec.every == min(self._wiring.periods.values()),
            fails_self_test=fails_self_test,
            entries=None,
            exchange=build_exchanges(self._wiring, ports),
            scheduling=build_scheduling(self._config, ports.place, spec.every, is_locked=is_locked),
            compares=board.compare,
            votes=board.vote,
            budget_ns=round((board.busy_ms if is_executor else board.planning_ms) * 1e6),
            transfer=BusTimes(
                **{f"{key.removesuffix('_ms')}_ns": round(ms * 1e6) for key, ms in board.transfer}
            ),
        )

    def _build_board_contexts(self, wiring: Wiring) -> dict[str, LevelContext]:
        """Return a dictionary from board to the context of its level."""
        every = wiring.periods
        boards = wiring.config.board
        paces = {
            name: Pace(every[name], board.within_cycles, board.params)
            for name, board in boards.items()
        }
        return {
            name: self._build_context(
                name,
                board.params,
                every=every[name],
                phase=board.phase,
                within_cycles=board.within_cycles,
                above={other: paces[other] for other in board.above},
                below={other: paces[other] for other in board.below},
            )
            for name, board in boards.items()
            # Omit boards whose neighbours are missing because of mistakes.
            if boards.keys() >= {*board.above, *board.below}
        }

    def _build_context(self, name: str, params: Mapping[str, Any], **times: Any) -> LevelContext:
        """Return the context of a level or host program. `times` are its timing fields."""
        config = self._config
        return LevelContext(
            board=name,
            clock_ns=config.clock_ns,
            seed=config.seed,
            # The robot is None only in a rack without an arm, whose levels do not use it.
            robot=cast(RobotConfig, config.robot),
            scene=config.scene,
            task=config.task,
            sizes=self._sizes,
            params=params,
            rack=config.name,
            **times,
        )


def _remove_broken_boards(config: RackConfig, broken: frozenset[str]) -> RackConfig:
    """Return a config without the boards and host boards that have mistakes."""
    tables = remove_tables({"board": config.board, "host": config.host}, broken)
    if "adapter" in broken:
        tables["board"].pop(LAN, None)
    return config.model_copy(update=tables)
