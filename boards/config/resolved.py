"""From a config to a rack: `resolve` checks and wires everything, once.

`rack.boards.config.loader` reads the config before that, so that at launch the crate imports the
levels while this process resolves the config.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout
from rack.backplane.operator_table import Request
from rack.backplane.words import Demand
from rack.boards.config.cell import cell_sizes
from rack.boards.config.commands import command_mistakes, requests
from rack.boards.config.connections import TaskPorts, Wiring
from rack.boards.config.injections import fault_mistakes, injections, places
from rack.boards.config.layout import KEPT_S, LayoutMaker, exchanges, obtained_core
from rack.boards.config.published import PublishedRack, publish
from rack.boards.config.rules import broken_rules, network_rules
from rack.boards.config.rules.levels import memory, neighbours, sizes
from rack.boards.config.schema import LAN, CommandConfig, RackConfig
from rack.boards.config.timing import is_critical, reservation
from rack.boards.config.toml import table_of, without
from rack.boards.errors import ConfigError, Mistake
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kind import KINDS
from rack.boards.wiring import (
    BusTimes,
    ClockWiring,
    Entries,
    HostWiring,
    TaskWiring,
    mailboxes_of,
)
from rack.levels.level import LevelContext, Pace
from rack.levels.tables import GoalConfig, RobotConfig

LINGER_S = 0.5
"""Simulated time that a run continues after the task ends, to let the arm come to rest."""
SILENT_S = 30.0
"""Simulated time without a status after which the level that ends the run counts as dead; at least
8 of its cycles."""
AHEAD_S = KEPT_S / 2
"""Simulated time by which lockstep may run ahead of a recorder: half of the time that the rings
retain."""
LAYOUT_NEEDS = {"clock", "protocol", "robot", "scene", "task"}
"""Tables without which there is no layout, and no level can judge its neighbours."""


def resolve(config: RackConfig) -> Resolved:
    """Check and wire a config to run on this machine, now. Raises `ConfigError` with every
    mistake.
    """
    network = network_rules(config)
    further = () if network is None else network.credential_mistakes(config)
    return _examined(config, further).resolved()


def wire(config: RackConfig) -> Layout:
    """Return the layout of a config, which may have run elsewhere. Raises `ConfigError` with every
    mistake.
    """
    return _examined(config).resolved().layout


def classes(config: RackConfig) -> tuple[str, ...]:
    """Return the classes of all levels, for the crate to preload while the config is checked."""
    return tuple(dict.fromkeys(place.target for place in config.tasks()))


@dataclass(frozen=True)
class Resolved:
    """A checked config with everything derived from it, ready to launch."""

    config: RackConfig
    layout: Layout
    tasks: tuple[TaskWiring, ...]
    hosts: tuple[HostWiring, ...]
    faults: tuple[Injection, ...]
    commands: tuple[Request, ...]
    published: PublishedRack
    goals: Mapping[int, GoalConfig]  # where objects end, by their rows in the scene

    def for_run(self, repeats: str, entries: Mapping[str, Entries] | None) -> Resolved:
        """Return the rack for one run.

        `repeats`: the name that its levels see, which may stand in their messages; empty: its own.
        `entries`: of a replay, which has no host boards and other racks, but what each adapter
        wrote in the recorded run.
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

    @property
    def is_replay(self) -> bool:
        """Whether what came from outside in a recorded run comes again."""
        return any(task.entries is not None for task in self.tasks)

    def clock(self, seconds: float | None) -> ClockWiring:
        """Return the clock's wiring for a run of `seconds` of simulated time; None: until the task
        ends.
        """
        config = self.config
        clock = config.clock
        ends_run = self.ends_run
        silent = self._ticks(SILENT_S)
        if ends_run is not None:
            writer = self.layout.mailbox(ends_run).writer
            silent = max(silent, 8 * self.layout.task(writer).every)
        executors = [task for task in self.layout.tasks if task.role == "executor"]
        core = obtained_core(clock.core)
        # In lockstep the core of the fastest board, since a switch is faster than waking up a core.
        # A polling board does not give its core away.
        if config.is_lockstep and (giving := [task for task in executors if task.wake != "poll"]):
            core = min(giving, key=lambda task: (task.every, task.slot)).core
        # The demand on the arm while a board is lost; none if the level below holds.
        demands = {"hold": Demand.NONE, "stop": Demand.STOP, "brake": Demand.BRAKE}
        return ClockWiring(
            lockstep=config.is_lockstep,
            period_ns=config.tick_ns,
            stop_tick=0 if seconds is None else max(1, self._ticks(seconds)),
            ends_run=ends_run,
            linger=self._ticks(LINGER_S),
            silent=silent,
            history=self._ticks(AHEAD_S),
            core=core,
            priority=clock.priority,
            keeps_awake=not config.is_lockstep and clock.idle_cores == "awake",
            reservation=reservation(config, config.timing.clock_ms, 1),
            restart_ticks=max(1, self._ticks(config.supervision.lockstep_restart_s)),
            on_loss={task.name: demands[config.board[task.board].on_loss] for task in executors},
        )

    def _ticks(self, seconds: float) -> int:
        return round(seconds * 1e9 / self.config.clock_ns)

    @property
    def ends_run(self) -> str | None:
        """The status mailbox whose state ends the run; None: no level ends it."""
        return next(
            (f"{name}.status" for name, board in self.config.board.items() if board.ends_run), None
        )

    @property
    def crate_priority(self) -> int:
        """SCHED_FIFO priority of the crate: below all real-time boards, above all ordinary
        processes.
        """
        priorities = [t.priority for t in self.layout.tasks if t.priority and t.role == "executor"]
        return max(min(priorities, default=0) - 1, 0)


def _examined(config: RackConfig, further: Iterable[Mistake] = ()) -> Examination:
    commands = [(f"command[{at}]", command) for at, command in enumerate(config.command)]
    examined = Examination(config, places(config), commands)
    if mistakes := [*examined.mistakes, *further]:
        raise ConfigError(mistakes)
    return examined


class Examination:
    """A config with the findings of its check.

    `broken` names tables that were removed for mistakes already known; nothing that depends on them
    is checked.
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
        self.mistakes = broken_rules(self._wiring)
        unsound = broken.union(table_of(mistake.place) for mistake in self.mistakes)
        wiring = self._wiring if not unsound else Wiring(_reduced(config, unsound), unsound)
        if wiring.tasks and not unsound & LAYOUT_NEEDS:
            self._sizes = cell_sizes(config)
            self.mistakes += (wrong := [*sizes(wiring, self._sizes)])
            if not wrong:
                self._layout = LayoutMaker(wiring, self._sizes).layout()
                self._contexts = self._contexts_of_boards(wiring)
                self.mistakes += memory(self._layout)
                self.mistakes += neighbours(wiring, self._contexts)
        self._published = publish(config)
        levels = self._published.levels
        self.mistakes += fault_mistakes(faults, config, levels, self._layout, wiring.unknown)
        broken_boards = self._wiring.broken_boards
        self.mistakes += command_mistakes(commands, config, levels, broken_boards)
        if (network := network_rules(config)) is not None:
            self.mistakes = [network.at_adapter(mistake, config) for mistake in self.mistakes]

    def resolved(self) -> Resolved:
        """Return everything derived from a config without mistakes."""
        config = self._config
        layout = self._layout
        assert layout is not None, "no mistakes"
        faults = injections(config, layout)
        failing = {
            layout.tasks[fault.task].name for fault in faults if KINDS[fault.kind].where == "start"
        }
        tasks = tuple(
            self._task(layout, ports, ports.task in failing) for ports in self._wiring.tasks
        )
        hosts = tuple(self._host(ports) for ports in self._wiring.hosts)
        # A goal that the config states replaces that of the program.
        rows = config.scene.objects.index
        programs = [program.model_validate(config.task) for program in self._wiring.programs]
        goals = [goal for program in programs for goal in program.goals()]
        at = {rows(goal.object): goal for goal in (*goals, *config.scene.goal)}
        commands = requests(config, layout)
        return Resolved(config, layout, tasks, hosts, faults, commands, self._published, at)

    def _host(self, ports: TaskPorts) -> HostWiring:
        config = self._config
        name = ports.place.board
        return HostWiring(
            board=name,
            target=ports.place.target,
            inputs=dict(ports.sources),
            outputs=dict(ports.writes),
            context=self._context(name, config.host[name].params, every=1, within_cycles=1),
            is_external=config.host[name].external,
            computing=round(config.host[name].computing_ms * 1e6 / config.clock_ns),
        )

    def _task(self, layout: Layout, ports: TaskPorts, fails_self_test: bool) -> TaskWiring:
        board = self._config.board[ports.place.board]
        spec = layout.task(ports.task)
        is_executor = spec.role == "executor"
        # What is on the host side, a bus adapter exchanges by itself.
        of_host = self._wiring.of_host
        from_host = self._wiring.from_host
        is_locked = not is_executor and is_critical(self._config, layout, spec.board)
        return TaskWiring(
            task=ports.task,
            target=ports.place.target,
            inputs={
                port: source
                for port, source in ports.reads.items()
                if not from_host.intersection(mailboxes_of(source))
            },
            outputs={port: box for port, box in ports.writes.items() if box not in of_host},
            context=self._contexts[spec.board],
            critical_priority=board.priority if is_locked else 0,
            sent=tuple(port for port, output in ports.outputs.items() if output.queued),
            guards_clock=is_executor and spec.every == min(self._wiring.every.values()),
            fails_self_test=fails_self_test,
            entries=None,
            exchange=exchanges(self._wiring, ports),
            # Planners are below all reservations.
            reservation=reservation(
                self._config, board.busy_ms if is_executor else 0.0, spec.every
            ),
            transfer=BusTimes(
                **{f"{key.removesuffix('_ms')}_ns": round(ms * 1e6) for key, ms in board.transfer}
            ),
        )

    def _contexts_of_boards(self, wiring: Wiring) -> dict[str, LevelContext]:
        every = wiring.every
        boards = wiring.config.board
        paces = {name: Pace(every[name], board.within_cycles) for name, board in boards.items()}
        return {
            name: self._context(
                name,
                board.params,
                every=every[name],
                phase=board.phase,
                within_cycles=board.within_cycles,
                above={other: paces[other] for other in board.above},
                below={other: paces[other] for other in board.below},
            )
            for name, board in boards.items()
            # The neighbours of any other board have mistakes of their own.
            if boards.keys() >= {*board.above, *board.below}
        }

    def _context(self, name: str, params: Mapping[str, Any], **times: Any) -> LevelContext:
        config = self._config
        return LevelContext(
            board=name,
            clock_ns=config.clock_ns,
            seed=config.seed,
            # In a rack without an arm no level uses it.
            robot=cast(RobotConfig, config.robot),
            scene=config.scene,
            task=config.task,
            sizes=self._sizes,
            params=params,
            rack=config.name,
            **times,
        )


def _reduced(config: RackConfig, unsound: frozenset[str]) -> RackConfig:
    """Return a config without the boards and host boards that have mistakes."""
    kept = without({"board": config.board, "host": config.host}, unsound)
    if "adapter" in unsound:
        kept["board"].pop(LAN, None)
    return config.model_copy(update=kept)
