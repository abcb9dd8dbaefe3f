"""One run: launched, watched, recorded, and ended in order however it ends."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
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
from rack.boards.events import Event, Outcome
from rack.boards.wiring import Continuation, Entries
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.faults.ending import Strike, strikes
from rack.tools.launch.folder import EventLog
from rack.tools.launch.other_racks import OtherEnd, OtherRacks
from rack.tools.launch.verdict import list_failures
from rack.tools.monitor.display import Display
from rack.tools.monitor.holds import Standstill
from rack.tools.monitor.newest_messages import Newest
from rack.tools.monitor.queues import queue_fills
from rack.tools.monitor.snapshot import RackMonitor
from rack.tools.recording.origin import Origin, write_code
from rack.tools.recording.recorder.process import RecorderProcess

COUNTED = (
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
"""Words of a task's control block that a result keeps."""
NO_TIME = "no time for the report: 'rack report {}' makes it"
VIEWER = "rack.tools.viewer.window"
"""What shows a run while it is recorded, by name: running and recording need none of it."""
NO_RECORDER = "the recorder has not begun yet: real time begins without it, lockstep waits"

News = Callable[[], list[str]]
"""Returns messages for the user since the last call, of the recorder or the viewer."""


@dataclass(frozen=True)
class Beginning:
    """What a run goes on from: a snapshot in a crate, which without one is just started earlier;
    the commands that its operators gave; what its host boards and other racks sent, which are not
    started then; and which run that is, for the record.
    """

    continues: Continuation | None = None
    crate: CrateLine | None = None
    requests: tuple[Request, ...] = ()
    entries: Mapping[str, Entries] | None = None
    origin: Origin | None = None


ANEW = Beginning()


@dataclass(frozen=True)
class RunResult:
    """A finished run: its outcome, the counts of every task's control block, and the faults
    injected into it.

    `clock_offset_ns` converts CLOCK_MONOTONIC, in which boards stamp, to the time of the events.
    `refused`: messages that full queues refused, by queue. `recording` is "complete", "none" (not
    wanted), or what is missing; `rows_lost` are the rows missing, by task and by mailbox. `others`
    are the racks launched with this one; `failed` says which of them failed, and why.
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
    others: tuple[OtherEnd, ...] = ()
    failed: str = ""

    @property
    def worked(self) -> bool:
        """Whether the run succeeded as far as its end shows it: only a report judges its system
        response.
        """
        return not self.failure()

    def failure(self) -> str:
        """Return in one line why the run did not succeed."""
        return "; ".join(list_failures(self.outcome, self.recording, self.failed))


def run_rack(
    config: RackConfig,
    seconds: float | None,
    folder: Path | None,
    display: Display,
    *,
    view: bool = False,
    share: bool = True,
    step: bool = False,
    begins: Beginning = ANEW,
) -> RunResult:
    """Run a rack for `seconds` of simulated time, or until its task ends; record it into `folder`
    unless that is None.

    With `view`, open a viewer on what the recorder serves; it may be closed at any time. With
    `step`, in lockstep, hold before tick 0 until the rack is stepped. `share` is as
    in `Rack`; `begins`: the crate, and the run that it continues or repeats. Launch the racks that
    the config names: one that fails ends the run, and a run that does not succeed ends them.

    Raises what `Rack` raises; a rack that could not be launched leaves no folder. A recorder that
    dies does not end the run, but files that cannot be written do: raises `Failure`.
    """
    log = EventLog(display)
    with closing(log), ExitStack() as stack:
        # Until the run has begun there is nothing to keep.
        with INTERRUPT.at_once():
            lan = config.adapter.lan
            # In a replay what they sent enters again.
            launches = lan.launch if lan is not None and begins.entries is None else ()
            others = stack.enter_context(OtherRacks(launches, config, seconds, folder is not None))
            recorder = None if folder is None else RecorderProcess(folder)
            if recorder is not None:
                stack.callback(recorder.finish)
            rack = stack.enter_context(
                Rack(
                    config,
                    log.add,
                    share or bool(others),
                    begins.crate,
                    begins.entries,
                    continues=begins.continues,
                    requests=begins.requests,
                )
            )
            segment = rack.segment
            segment.words[System.HOLD_AT] = int(step)
            news: list[News] = []
            if recorder is not None:
                news.append(recorder.news)
                begin_folder(recorder.folder, config, log, begins.origin)
                port = import_module(VIEWER).free_port() if view else None
                if not recorder.attach(config.name, port, segment.words):
                    log.add(Event(time.time_ns(), -1, "recorder", "", NO_RECORDER))
                if port is not None:
                    news.append(_open_viewer(port))

        def log_news() -> None:
            for text in [text for source in news for text in source()]:
                log.add(Event(time.time_ns(), segment.words[System.TICK], "recorder", "", text))

        unfinished = NO_TIME.format(folder) if folder else ""
        with INTERRUPT.orderly(lambda: rack.stop(f"{INTERRUPT.name} received"), unfinished):
            started = time.monotonic()
            outcome = _watch(rack, seconds, display, log, log_news, others)
            wall_s = time.monotonic() - started
        log_news()
        if recorder is not None and not INTERRUPT.number:
            # Later it would find no rack to attach to.
            recorder.await_begun()
        rack.close()
        recording, rows_lost = "none", dict[str, int]()
        if recorder is not None:
            ended = recorder.finish(in_a_hurry=INTERRUPT.number != 0)
            recording, rows_lost = compare_recording(recorder.folder, segment, ended, outcome.ticks)
        log_news()
        failed = others.finish()
        result = replace(
            result_of(segment, config, outcome, wall_s, recording, rows_lost),
            others=others.ends(),
            failed=failed,
        )
        log.end(asdict(result))
        cut_off = replace(result, recording="events.jsonl ends before the run")
        return cut_off if log.has_failed else result


def begin_folder(
    folder: Path, config: RackConfig, log: EventLog, origin: Origin | None = None
) -> None:
    """Write what is known when a run begins into its folder: config, code, the events so far.
    Raises `Failure`.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "config.toml").write_text(config.text())
        write_code(config, folder)
        if origin is not None:
            origin.write(folder)
        log.open(folder / "events.jsonl")
    except OSError as error:
        raise Failure(f"{folder}: {error.strerror}") from None


def result_of(
    segment: Segment,
    config: RackConfig,
    outcome: Outcome,
    wall_s: float,
    recording: str,
    rows_lost: dict[str, int],
) -> RunResult:
    """Return the result of a run that is over, by the words of its segment."""
    return RunResult(
        rack=config.name,
        outcome=outcome,
        wall_s=wall_s,
        clock_skipped=segment.words[System.CLOCK_SKIPPED],
        tasks={
            task.name: {
                **{
                    name.lower(): segment.block(task.name)[getattr(Block, name)] for name in COUNTED
                },
                **segment.count_cycles(task, outcome.ticks)._asdict(),
            }
            for task in segment.layout.tasks
        },
        recording=recording,
        rows_lost=rows_lost,
        faults=strikes(segment, config.joints),
        clock_offset_ns=time.time_ns() - time.monotonic_ns(),
        refused={queue.mailbox: queue.refused for queue in queue_fills(Newest(segment))},
    )


def _open_viewer(port: int) -> News:
    """Open the viewer on what the recorder serves; return its news. Without a viewer the rack runs
    all the same.
    """
    window = import_module(VIEWER)
    try:
        opened: News = window.ViewerWindow(window.url(port)).news
        return opened
    except Failure as failure:
        news = [f"no viewer: {failure}"]
        return lambda: [news.pop()] if news else []


def _watch(
    rack: Rack,
    seconds: float | None,
    display: Display,
    log: EventLog,
    log_news: Callable[[], None],
    others: OtherRacks,
) -> Outcome:
    """Run the rack to its end; show it, and log what only the host side can see."""
    rack.start(seconds)
    monitor = RackMonitor(rack.segment)
    standstill = Standstill(rack.segment)
    is_running = True
    while is_running:
        # The last look is at the rack's end: a run in lockstep may be over between two.
        is_running = rack.watch(display.period_s)
        display.show(monitor.look())
        log_news()
        for event in standstill.look():
            log.add(event)
        if why := others.failure():
            rack.stop(why)
    if rack.outcome is None:
        raise Failure("the run ended without an outcome")
    if not rack.outcome.worked:
        others.stop()
    return rack.outcome


def compare_recording(
    folder: Path, segment: Segment, why: str, ticks: int
) -> tuple[str, dict[str, int]]:
    """Compare the files with what the rings say was written; `why` is how the recorder ended.

    Return "complete" or what is missing, and the rows missing by task and by mailbox.
    """
    # Here, not above: its libraries would delay the launch.
    from rack.tools.recording.occasions import Retention
    from rack.tools.recording.recording import Recording
    from rack.tools.recording.run_files import find_missing, tally

    try:
        retention = Retention.of(segment)
        # A run that was interrupted has no time to make tables of what a flight recorder kept.
        left = None if retention is None else tally(folder)
        if retention is None or left is None:
            missing = Recording(folder).missing(segment)
        else:
            missing = find_missing(segment, left.taken, left.lost)
            if not missing and (absent := retention.absent(segment, left.kept, ticks)):
                first, last = absent[0]
                return f"ticks {first:,} to {last:,} had to be kept, and are not there", {}
        if not missing:
            return "complete", {}
        gaps = Recording(folder).gaps({name: rows for name, (rows, _) in missing.items()}, ticks)
    except Failure as error:
        return f"{why}; {error}", {}
    most, name = max((found, name) for name, found in missing.items())
    text = f"{most.rows:,} of {most.written:,} rows of {name} are missing"
    if len(missing) > 1:
        text += f" (and rows of {len(missing) - 1} more tasks and mailboxes)"
    return "; ".join((text, *map(str, gaps), why)), {
        name: found.rows for name, found in missing.items()
    }
