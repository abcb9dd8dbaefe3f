"""Launches a rack, watches and records it, and ends it cleanly."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path

from rack.backplane.operator_table import Request
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import CrateLine
from rack.boards.events import Event, EventKind, Outcome
from rack.boards.wiring import Continuation, RecordedEntries
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.faults.ending import Strike, list_strikes
from rack.tools.launch.folder import EventLog
from rack.tools.launch.other_racks import OtherRackEnd, OtherRacks
from rack.tools.launch.verdict import list_failures
from rack.tools.monitor.display import Display
from rack.tools.monitor.holds import StandstillDetector
from rack.tools.monitor.newest_messages import NewestMessages
from rack.tools.monitor.queues import list_queue_fills
from rack.tools.monitor.snapshot import RackMonitor
from rack.tools.recording.joined import write_joined_paths
from rack.tools.recording.origin import Origin, write_code_state
from rack.tools.recording.recorder.process import RecorderProcess

COUNTED_WORDS = (
    "CYCLES",
    "PLANS",
    "DONE",
    "PRIORITY",
    "CORE",
    "READS",
    "READ_BYTES",
    "WRITES",
    "WRITE_BYTES",
    "CORRUPT",
    "BUS_ERRORS",
)
"""Words of a task's control block that are copied to the result of a run."""
UNFINISHED_HINT = "no time for the report: 'rack report {}' makes it"
VIEWER = "rack.tools.viewer.window"
BRIDGES = "rack.tools.bridges.process"
"""Modules of the viewer and of bridges, imported by name because no run needs them."""
NO_RECORDER = "the recorder has not begun yet: real time begins without it, lockstep waits"

News = Callable[[], list[str]]
"""Function that returns new messages of the recorder, the viewer or a bridge for the user."""


@dataclass(frozen=True)
class Beginning:
    """State from which a run begins.

    Attributes:
        continues: Snapshot in the crate. None to begin at tick 0.
        crate: A crate that was started earlier, to save time or because it has the snapshot.
        requests: Commands of operators to repeat.
        entries: Recorded messages of host boards and other racks, which are not started in that
            case.
        origin: The run that is continued, to be recorded.
        earlier: Events of that run before this state.
    """

    continues: Continuation | None = None
    crate: CrateLine | None = None
    requests: tuple[Request, ...] = ()
    entries: Mapping[str, RecordedEntries] | None = None
    origin: Origin | None = None
    earlier: tuple[Event, ...] = ()


FROM_START = Beginning()
"""A run from tick 0."""


@dataclass(frozen=True)
class RunResult:
    """A finished run: its outcome, its faults, and the counts from every task's control block.

    Attributes:
        recording: "complete", "none" if no recording was wanted, or a text that states what is
            missing.
        rows_lost: Dictionary from task or mailbox to its number of missing rows.
        clock_offset_ns: Time to add to CLOCK_MONOTONIC, which boards use, to get the wall-clock
            time of events.
        refused: Dictionary from queue to the number of messages that it refused because it was
            full.
        others: Racks that were launched with this one.
        failed: Which of these other racks failed, and why. Empty if none did.
        earlier: Events of the continued run before this one. Faults may have been detected there.
    """

    rack: str
    outcome: Outcome
    wall_s: float
    clock_skipped: int
    tasks: dict[str, dict[str, int]]
    recording: str
    rows_lost: dict[str, int]
    faults: tuple[Strike, ...]
    clock_offset_ns: int
    refused: dict[str, int]
    others: tuple[OtherRackEnd, ...] = ()
    failed: str = ""
    earlier: tuple[Event, ...] = ()

    @property
    def worked(self) -> bool:
        """True if no failure is known at the end of the run.

        The system response is evaluated later, in the report.
        """
        return not list_failures(self.outcome, self.recording, self.failed)


def run_rack(
    config: RackConfig,
    seconds: float | None,
    folder: Path | None,
    display: Display,
    *,
    view: bool = False,
    share: bool = True,
    step: bool = False,
    bridges: Sequence[str] = (),
    beginning: Beginning = FROM_START,
) -> RunResult:
    """Run a rack, and record it.

    The other racks that the config names are launched as well. If one of them fails, this run ends.
    If this run fails, they are ended. A recorder that dies does not end the run.

    Args:
        config: Config of the rack.
        seconds: Simulated duration of the run. None to run until its task ends.
        folder: Folder of the run. None to record nothing.
        display: Shows the run.
        view: True to open a viewer on the recorder. The user may close it at any time.
        share: As in `Rack`.
        step: True to hold the rack before tick 0 until it is stepped. Only in lockstep.
        bridges: Names of bridges to other tools.
        beginning: Crate, snapshot and entries of a run that is continued or repeated.

    Raises:
        Failure: A file cannot be written. Errors of `Rack` are raised as well; a rack that could
            not be launched leaves no folder.
    """
    log = EventLog(display)
    with closing(log), ExitStack() as stack:
        # Until the run has begun there is nothing to save, so a signal may end it at once.
        with INTERRUPT.stop_orderly(INTERRUPT.end_process):
            lan = config.adapter.lan
            # A repeated run replays the recorded messages of other racks instead.
            launches = lan.launch if lan is not None and beginning.entries is None else ()
            others = stack.enter_context(OtherRacks(launches, config, seconds, folder is not None))
            recorder = None if folder is None else RecorderProcess(folder)
            if recorder is not None:
                stack.callback(recorder.finish)
            rack = stack.enter_context(
                Rack(
                    config,
                    log.add_event,
                    share or bool(others),
                    beginning.crate,
                    beginning.entries,
                    continues=beginning.continues,
                    requests=beginning.requests,
                )
            )
            rack.events.extend(beginning.earlier)
            segment = rack.segment
            segment.words[System.HOLD_AT] = int(step)
            news: list[tuple[EventKind, News]] = []
            if recorder is not None:
                news.append(("recorder", recorder.read_notices))
                create_run_folder(recorder.folder, config, log, beginning.origin)
                port = import_module(VIEWER).find_free_port() if view else None
                if not recorder.attach(config.name, port, segment.words):
                    log.add_event(Event(time.time_ns(), -1, "recorder", "", NO_RECORDER))
                if port is not None:
                    news.append(("recorder", import_module(VIEWER).open_window(port)))
            news += [
                ("printed", import_module(BRIDGES).start_bridge(name, config.name, stack))
                for name in bridges
            ]

        def log_news() -> None:
            """Log new messages of the recorder, the viewer and the bridges."""
            for kind, read_notices in news:
                for text in read_notices():
                    log.add_event(Event(time.time_ns(), segment.tick, kind, "", text))

        unfinished = UNFINISHED_HINT.format(folder) if folder else ""
        with INTERRUPT.stop_orderly(lambda: rack.stop(f"{INTERRUPT.name} received"), unfinished):
            started = time.monotonic()
            outcome = _watch_rack(rack, seconds, display, log, log_news, others)
            wall_s = time.monotonic() - started
        log_news()
        if recorder is not None and not INTERRUPT.number:
            # Wait for the recorder, because it cannot attach to a closed rack.
            recorder.wait_until_attached()
        rack.close()
        recording, rows_lost = "none", dict[str, int]()
        if recorder is not None:
            ended = recorder.finish(in_a_hurry=INTERRUPT.number != 0)
            recording, rows_lost = compare_recording(recorder.folder, segment, ended, outcome.ticks)
        log_news()
        failed = others.await_end()
        result = replace(
            build_result(segment, config, outcome, wall_s, recording, rows_lost),
            others=tuple(others.list_ends()),
            failed=failed,
            earlier=beginning.earlier,
        )
        log.write_outcome(asdict(result))
        cut_off = replace(result, recording="events.jsonl ends before the run")
        return cut_off if log.has_failed else result


def create_run_folder(
    folder: Path, config: RackConfig, log: EventLog, origin: Origin | None = None
) -> None:
    """Create the folder of a run, with config, code and the events so far.

    Args:
        folder: The folder.
        config: Config of the rack.
        log: Event log, which starts to write to the folder.
        origin: The run that is continued, or None.

    Raises:
        Failure: A file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "config.toml").write_text(config.to_toml_text())
        write_code_state(config, folder)
        write_joined_paths(config, folder)
        if origin is not None:
            origin.write(folder)
        log.open_file(folder / "events.jsonl")
    except OSError as error:
        raise Failure(f"{folder}: {error.strerror}") from None


def build_result(
    segment: Segment,
    config: RackConfig,
    outcome: Outcome,
    wall_s: float,
    recording: str,
    rows_lost: dict[str, int],
) -> RunResult:
    """Build the result of a finished run from the counts in its segment.

    Args:
        segment: Segment of the rack, still attached.
        config: Config of the rack.
        outcome: Outcome of the run.
        wall_s: Wall-clock duration of the run.
        recording: As in `RunResult`.
        rows_lost: As in `RunResult`.
    """
    return RunResult(
        rack=config.name,
        outcome=outcome,
        wall_s=wall_s,
        clock_skipped=segment.words[System.CLOCK_SKIPPED],
        tasks={
            task.name: {
                **{
                    name.lower(): segment.get_block(task.name)[getattr(Block, name)]
                    for name in COUNTED_WORDS
                },
                **segment.count_cycles(task, outcome.ticks)._asdict(),
            }
            for task in segment.layout.tasks
        },
        recording=recording,
        rows_lost=rows_lost,
        faults=list_strikes(segment, config.joints),
        clock_offset_ns=time.time_ns() - time.monotonic_ns(),
        refused={
            queue.mailbox: queue.refused for queue in list_queue_fills(NewestMessages(segment))
        },
    )


def _watch_rack(
    rack: Rack,
    seconds: float | None,
    display: Display,
    log: EventLog,
    log_news: Callable[[], None],
    others: OtherRacks,
) -> Outcome:
    """Run the rack to its end, show it, and log events that no board reports."""
    rack.start(seconds)
    monitor = RackMonitor(rack.segment)
    standstill = StandstillDetector(rack.segment)
    is_running = True
    while is_running:
        # Take one more snapshot after the end: a lockstep run may end between two snapshots.
        is_running = rack.watch(display.period_s)
        display.show(monitor.take_snapshot())
        log_news()
        for event in standstill.list_events():
            log.add_event(event)
        if why := others.describe_failures():
            rack.stop(why)
    if rack.outcome is None:
        raise Failure("the run ended without an outcome")
    if not rack.outcome.is_success:
        others.stop_racks()
    return rack.outcome


def compare_recording(
    folder: Path, segment: Segment, why: str, ticks: int
) -> tuple[str, dict[str, int]]:
    """Compare the number of rows in the files of a run with the number written to the rings.

    Args:
        folder: Folder of the run.
        segment: Segment of the rack.
        why: How the recorder ended.
        ticks: Ticks of the run.

    Returns:
        "complete" or a text that states what is missing, and a dictionary from task or mailbox to
        its number of missing rows.
    """
    # Import late, because these libraries would delay the launch.
    from rack.tools.recording.occasions import Retention
    from rack.tools.recording.recording import Recording
    from rack.tools.recording.run_files import count_spool, find_missing

    try:
        retention = Retention.from_config(segment)
        # An interrupted run has no time to convert the rows of a flight recorder to tables.
        left = None if retention is None else count_spool(folder)
        if retention is None or left is None:
            missing = Recording(folder).count_missing_rows(segment)
        else:
            missing = find_missing(segment, left.taken, left.lost)
            if not missing and (
                absent := retention.find_missing_windows(segment, left.kept, ticks)
            ):
                first, last = absent[0]
                return f"ticks {first:,} to {last:,} should have been kept but are missing", {}
        if not missing:
            return "complete", {}
        rows_lost = {name: loss.rows for name, loss in missing.items()}
        gaps = Recording(folder).find_gaps(rows_lost, ticks)
    except Failure as error:
        return f"{why}; {error}", {}
    most, name = max((loss, name) for name, loss in missing.items())
    text = f"{most.rows:,} of {most.written:,} rows of {name} are missing"
    if len(missing) > 1:
        text += f" (and rows of {len(missing) - 1} more tasks and mailboxes)"
    return "; ".join((text, *map(str, gaps), why)), rows_lost
