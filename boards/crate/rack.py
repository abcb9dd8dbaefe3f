"""The Rack: launches the boards of a config, supervises them, and ends them."""

from __future__ import annotations

import atexit
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Self

from rack.backplane.address_map import CLOCK
from rack.backplane.exclusive_cores import release_cores
from rack.backplane.fault_table import FaultTable
from rack.backplane.operator_table import OperatorTable, Request, RequestEntry
from rack.backplane.segment import Segment
from rack.backplane.standby import list_standbys
from rack.backplane.words import Block, System
from rack.boards.config.commands import build_request, parse_command
from rack.boards.config.loader import load
from rack.boards.config.resolved import Resolved, resolve
from rack.boards.config.schema import RackConfig
from rack.boards.crate import launch_checks
from rack.boards.crate.clean import remove_dead_rack, remove_own_racks
from rack.boards.crate.line import CrateLine
from rack.boards.crate.neighbours import find_conflicts, find_holders, move_boards
from rack.boards.crate.patience import await_open_segment
from rack.boards.crate.requests import CellConfig, Open, PowerOff, PowerOn, Preload
from rack.boards.crate.supervisor import STOP_S, Supervisor
from rack.boards.errors import ConfigError, Mistake, SnapshotError
from rack.boards.events import CONTINUATION_CODE, Event, Journal, Outcome
from rack.boards.faults.kind import KINDS
from rack.boards.wiring import Continuation, RecordedEntries, SnapshotPolicy

LAUNCH_S = 60.0
"""Time limit for each step of the launch, such as preloading one class or starting all boards."""
TO_SHARE = "stop that rack, choose other cores, or use --share"
BOARDS_END_S = 2.0
"""Time that the boards have to end by themselves."""
WATCH_S = 0.5
"""Time between two checks of the boards if none of them reports anything."""


class Rack:
    """Rack of boards: launches, supervises and ends them.

    Use it as a context manager: `with Rack.from_file("nasrem") as rack: rack.run(seconds=10)`.

    Args:
        config: Config of the rack.
        on_event: Function called with every `Event` in this process. During a run in the background
            it is called in the background thread.
        share: Whether this rack may use cores that real-time boards of other racks occupy. If
            False, a launch on such cores is refused.
        crate: A running crate, which makes the launch faster. None to start one.
        entries: For a replay, the messages that each adapter wrote in the recorded run. Adapters
            write them again. No host boards are started and no other racks are contacted.
        snapshots: When to take snapshots, which requires lockstep. None for no snapshots.
        continues: Snapshot of `crate` from which the run continues. None to start a new run.
        requests: Further operator commands, sorted by tick.
        repeats: Name of the rack whose run is repeated. Levels see it as the name of their rack.

    Attributes:
        begins_at: Tick of the snapshot from which the run continues. -1 without one.
    """

    def __init__(
        self,
        config: RackConfig,
        on_event: Callable[[Event], None] | None = None,
        share: bool = True,
        crate: CrateLine | None = None,
        entries: Mapping[str, RecordedEntries] | None = None,
        snapshots: SnapshotPolicy | None = None,
        continues: Continuation | None = None,
        requests: Sequence[Request] = (),
        repeats: str = "",
    ) -> None:
        self.config = config
        self._repeats = repeats
        self._requests = requests
        self._entries = entries
        self._snapshots = snapshots
        self._continues = continues
        self.begins_at = -1
        self._share = share
        self._journal = Journal(on_event)
        self._crate = crate
        self._launched: Supervisor | None = None
        self._thread: Thread | None = None
        self._failed: BaseException | None = None

    @property
    def events(self) -> list[Event]:
        """Events of the run, in the order in which they were recorded.

        Before a continued run starts, the events that precede its snapshot may be added. The
        outcome takes them into account.
        """
        return self._journal.events

    @property
    def segment(self) -> Segment:
        """Segment of the rack. Use it only after the launch."""
        return self._supervisor.segment

    @property
    def outcome(self) -> Outcome | None:
        """Outcome of the run. None while it lasts."""
        return None if self._launched is None else self._launched.outcome

    @classmethod
    def from_file(cls, name_or_path: str | Path, overrides: Sequence[str] = ()) -> Self:
        """Create a rack from the name or path of a config, with settings `key.sub=value`.

        Raises:
            ConfigError: The config has mistakes. All of them are listed.
        """
        return cls(load(str(name_or_path), overrides))

    def __enter__(self) -> Self:
        if self._launched is None:
            self.launch()
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        self.close()
        if kind is None:
            # This raises an error that ended the supervision in the background.
            self.wait(0)

    def launch(self) -> None:
        """Power on every board except the clock, and wait until all have passed their self-tests.

        If this fails, it leaves no process and no segment behind.

        Raises:
            ConfigError: The config has mistakes, or the cores are occupied.
            SegmentError: The name of the rack is in use.
            LaunchError: A board failed, or this machine does not permit the launch.
        """
        try:
            self._power_on()
        except BaseException:
            self.close()
            raise

    def _power_on(self) -> None:
        """Carry out the launch. If this raises an error, the caller must close the rack."""
        occupied = find_holders(self.config.name)
        self.config, moved = move_boards(self.config, occupied)
        shared = find_conflicts(self.config, occupied)
        if shared and not self._share:
            raise ConfigError([Mistake(line, None, TO_SHARE) for line in shared])
        # Report shared cores first, because they slow down the next steps.
        for note in shared:
            self._journal.add_event("waiting", "", note)
        self._crate = crate = self._crate or CrateLine()
        # The crate imports levels while this process resolves the config, which saves 0.5 s on two
        # cores. If a level's module ends the crate, `resolve` reports which module that is.
        crate.try_request(build_preload_request(self.config))
        plan = resolve(self.config).for_run(self._repeats, self._entries)
        if self._snapshots is not None and (why := self._find_snapshot_obstacle(plan)):
            raise SnapshotError(f"rack '{self.config.name}' has no snapshots: {why}")
        launch_checks.check_open_files(plan)
        remove_dead_rack(self.config.name)
        segment = Segment.create(plan.layout, self.config.to_toml_text(), plan.published.to_json())
        self._journal.segment = segment
        words = segment.words
        # The emergency-stop latch is set first. The brakes stay engaged until it is reset.
        words[System.EMERGENCY_STOP] = 1
        words[System.LOCKSTEP] = self.config.is_lockstep
        words[System.PERIOD_NS] = self.config.tick_ns
        if (policy := self._snapshots) is not None:
            words[System.SNAPSHOT_PART] = policy.part
            words[System.SNAPSHOT_EVERY] = policy.every
            words[System.SNAPSHOT_AT] = 0 if policy.at is None else policy.at + 1
        before = None if self._continues is None else self._continues.tick
        # The supervisor reads the clock mode from the segment.
        self._launched = supervisor = Supervisor(segment, plan, crate, self._journal)
        crate.send_request(Open(self.config.name, plan.crate_priority, before))
        self._journal.add_event(
            "launch", "", f"{len(plan.tasks)} tasks, segment of {len(segment.bytes)} bytes"
        )
        self.begins_at = await_open_segment(crate, self._journal, LAUNCH_S)
        if before is not None and self.begins_at < 0:
            raise SnapshotError(f"rack '{self.config.name}': no snapshot before tick {before}")
        moved += launch_checks.reserve_cores(plan, segment)
        for wiring in plan.tasks:
            crate.send_request(PowerOn(wiring.task, wiring))
        supervisor.await_ready(LAUNCH_S)
        launch_checks.check_realtime(plan, segment)
        self._fill_tables(plan, crate)
        for note in (*moved, *launch_checks.list_launch_notes(plan, segment)):
            self._journal.add_event("ready", "", note)

    def _find_snapshot_obstacle(self, plan: Resolved) -> str:
        """Return why no snapshots can be taken. Empty if they can."""
        if not self.config.is_lockstep:
            return "they are taken in lockstep; add --lockstep"
        # In a replay there is no outside state: the wiring contains the recorded messages.
        is_replay = any(task.entries is not None for task in plan.tasks)
        return "" if is_replay else self.config.outside_state

    def _fill_tables(self, plan: Resolved, crate: CrateLine) -> None:
        """Enter faults and commands into their tables, and start the processes of hog faults."""
        table = FaultTable(self.segment)
        before = self._continues or Continuation(0)
        for injection in plan.faults[before.faults :]:
            entry = table.add_fault(injection)
            if KINDS[injection.kind].where == "core" and not self.config.is_lockstep:
                crate.send_request(PowerOn(f"hog {entry.index}", entry.index))
        desk = OperatorTable(self.segment)
        # A snapshot contains pending commands, and also leases of clients that no longer exist.
        for lease in desk.list_leased():
            desk.release_lease(lease)
        for request_entry in (
            *plan.commands[before.commands :],
            *desk.find_missing(self._requests),
        ):
            desk.add_request(request_entry)

    def start(self, seconds: float | None = None) -> None:
        """Power on the clock, which begins the run.

        Args:
            seconds: Simulated time in s that the run lasts. None to run until the task ends.
        """
        supervisor = self._supervisor
        plan = supervisor.plan
        clock = plan.build_clock_wiring(seconds)
        supervisor.longest = clock.longest if seconds is None else 0
        if self._snapshots is not None or self._continues is not None:
            # Keep the last tick out of the clock's wiring: a run that continues from a snapshot may
            # end at another tick, and its wiring must be the same.
            stop = max(clock.stop_tick, self.begins_at) if clock.stop_tick else 0
            self.segment.words[System.STOP_TICK] = stop
            clock = replace(clock, stop_tick=0)
        if self._continues is None:
            supervisor.reset_latch()
        else:
            # The snapshot contains the state of the latch. Discard alarms from before the snapshot,
            # which are events of the continued run.
            supervisor.is_armed = True
            supervisor.alarms.read_alarms()
            tick = self.begins_at
            self._journal.add_event(
                "launch", "", f"continues before tick {tick}", CONTINUATION_CODE, tick=tick
            )
            for board, lost in self._continues.losses:
                if lost < tick:
                    supervisor.policy.admit_restart(board, lost)
        for task in list_standbys(self.segment):
            name = task.active.name
            self._journal.add_event("start", name, f"'{name}' is active", "active", subject=name)
        supervisor.recovery.start(clock, plan)
        self._journal.add_event("start", CLOCK, self.config.clock.mode)

    def run(self, seconds: float | None = None) -> Outcome:
        """Run for `seconds` of simulated time, or until the task ends, and return the outcome."""
        self.start(seconds)
        while (outcome := self.outcome) is None:
            self.watch(WATCH_S)
        return outcome

    def run_in_background(self, seconds: float | None = None) -> None:
        """Begin a run as `run` does and return at once, while a thread supervises the boards.

        While other code holds the interpreter lock, the boards run but are not restarted.
        """
        self.start(seconds)
        # In a notebook a rack may never be closed, and the interpreter does not wait for a daemon
        # thread.
        atexit.register(self.close)
        self._thread = Thread(target=self._supervise, daemon=True)
        self._thread.start()

    def _supervise(self) -> None:
        """Supervise the boards until the run ends, in the background thread."""
        try:
            while self.watch(WATCH_S):
                continue
        except BaseException as error:
            # The boards are no longer supervised. `wait` and `__exit__` raise the error.
            self._failed = error
            self._supervisor.end_boards()

    def wait(self, timeout_s: float | None = None) -> Outcome | None:
        """Wait until the run in the background is over.

        Args:
            timeout_s: Longest time to wait in s. None to wait without a limit.

        Returns:
            The outcome. None if the run is not over.

        Raises:
            BaseException: The error that ended the supervision, such as one raised by `on_event`.
        """
        if self._thread is not None:
            self._thread.join(timeout_s)
        if self._failed is not None:
            raise self._failed
        return self.outcome

    def watch(self, timeout_s: float) -> bool:
        """Supervise the boards for up to `timeout_s`. Return False if the run has ended."""
        return self._supervisor.watch(timeout_s)

    def stop(self, why: str = "stopped by its program") -> None:
        """End the run at the next tick. Safe to call at any time, even in a signal handler."""
        self._supervisor.stop(why)

    def command(
        self, level: str, what: str, tick: int | None = None, **goal: object
    ) -> RequestEntry:
        """Issue an operator command to a level, as in `rack.command("task", "hold")`.

        Args:
            level: Board of the level.
            what: The command, as under the key `what` of a `[[command]]` table.
            tick: Tick at which it is issued. None for at once.
            goal: Further keys of a `[[command]]` table, such as `joints=(...)`.

        Returns:
            The entry of the command in the operator table.

        Raises:
            ConfigError: The command has mistakes. All of them are listed.
            OperatorTableError: Too many commands are pending.
        """
        command = parse_command({"level": level, "what": what, "tick": tick, **goal})
        plan = self._supervisor.plan
        entry = build_request(command, self.config, plan.published.levels, plan.layout)
        return OperatorTable(self.segment).add_request(entry)

    def close(self) -> None:
        """End the rack, its processes and its segment."""
        atexit.unregister(self.close)
        if (crate := self._crate) is None:
            return
        if self._thread is not None and self.outcome is None:
            self.stop()
            self._thread.join(STOP_S + BOARDS_END_S)
        self._crate = None
        leave_s = 0.0
        try:
            if (launched := self._launched) is not None:
                launched.end_boards()
                is_any_lost = any(
                    self.segment.get_block(task.name)[Block.LOST]
                    for task in launched.plan.layout.tasks
                )
                if is_any_lost or launched.recovery.given_up:
                    crate.try_request(PowerOff())
                # A crate without boards may still be importing, so do not wait for it.
                leave_s = BOARDS_END_S if launched.pids else 0.0
            crate.close(leave_s)
        finally:
            # Remove the segment by its name, because an interrupted launch may not have stored it.
            remove_own_racks(self.config.name)
            release_cores(self.config.name, wait_s=BOARDS_END_S)
            if self._launched is not None:
                self.segment.close()

    @property
    def _supervisor(self) -> Supervisor:
        """Supervisor of the rack. Use it only after the launch."""
        assert self._launched is not None, "the rack is launched"
        return self._launched


def build_preload_request(config: RackConfig) -> Preload:
    """Return the request to import and preload the levels of a rack and to compile its cell."""
    robot = config.robot
    cell = None if robot is None else CellConfig(robot, config.scene, config.clock_ns)
    classes = dict.fromkeys(task.target for task in config.list_tasks())
    return Preload(tuple(classes), tuple(sys.path), cell)
