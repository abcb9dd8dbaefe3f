"""One run: launched, watched, recorded, and ended, whatever way it ends."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rack.backplane.segment import Segment
from rack.backplane.words import Block, System
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event
from rack.boards.outcome import Outcome
from rack.boards.rack import Rack
from rack.tools.answer import Failure
from rack.tools.display import Display
from rack.tools.event_log import EventLog
from rack.tools.faults.ending import Strike, strikes
from rack.tools.holds import Standstill
from rack.tools.interrupt import INTERRUPT
from rack.tools.recorder.process import RecorderProcess
from rack.tools.snapshot import Viewer
from rack.tools.viewer.window import Window, free_port, url

COUNTED = (
    *("CYCLES", "PLANS", "MISSED", "SKIPPED", "PRIORITY", "CORE"),
    *("READS", "READ_BYTES", "WRITES", "WRITE_BYTES", "CORRUPT", "BUS_ERRORS"),
)


NO_TIME = "no time for the report: 'rack report {}' makes it"
LATE = "the recorder has not begun yet: the run begins without it"


@dataclass(frozen=True)
class RunResult:
    """A run that has ended: its outcome, what every task's control block counted, and what was injected into it.

    `clock_offset_ns` turns CLOCK_MONOTONIC, in which boards stamp, into the time of the events.
    """

    rack: str
    outcome: Outcome
    wall_s: float
    clock_skipped: int
    tasks: dict[str, dict[str, int]]
    recording: str
    faults: tuple[Strike, ...]
    clock_offset_ns: int

    @property
    def worked(self) -> bool:
        """Whether the run did what it was for."""
        return self.outcome.worked

    def failure(self) -> str:
        """Return why the run did not do what it was for, in one line."""
        end = self.outcome
        return f"{self.rack}: {end.cause}: {'; '.join(end.faults) or end.reason or f'after {end.ticks} ticks'}"

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {**asdict(self), "worked": self.worked}

    def text(self) -> str:
        """Return the outcome as text for people."""
        end = self.outcome
        lines = [f"{self.rack}: {end.cause} after {end.ticks} ticks{': ' + end.reason if end.reason else ''}"]
        lines += [f"fault: {fault}" for fault in end.faults]
        return "\n".join([*lines, f"digest {end.digest}"])


def run_rack(
    config: RackConfig,
    seconds: float | None,
    folder: Path | None,
    display: Display,
    view: bool = False,
    share: bool = True,
) -> RunResult:
    """Run a rack for `seconds` of simulated time, or until its task ends; record it into `folder`, if there is one.

    `share` is as in `Rack`. With `view` the recorder serves a viewer, whose window opens and may close at any time.

    Raises what `Rack` raises; a rack that could not be launched leaves no folder. What becomes of the recorder changes
    nothing in how the run ends.
    """
    log = EventLog(display)
    sources: list[Callable[[], list[str]]] = []
    with closing(log), ExitStack() as stack:
        # Nothing is worth keeping before the run has begun.
        with INTERRUPT.at_once():
            recorder = stack.enter_context(_recorder(folder))
            rack = stack.enter_context(Rack(config, log.add, share))
            if folder is not None and recorder is not None:
                folder.mkdir(parents=True, exist_ok=True)
                (folder / "config.toml").write_text(config.text())
                log.open(folder / "events.jsonl")
                port = free_port() if view else None
                if not recorder.attach(config.name, folder, port, rack.segment.words):
                    log.add(Event(time.time_ns(), -1, "recorder", "", LATE))
                sources = [recorder.told, *([] if port is None else [_window(port)])]
        unfinished = NO_TIME.format(folder) if folder else ""
        with INTERRUPT.orderly(lambda: rack.stop(f"{INTERRUPT.name} received"), unfinished):
            started = time.monotonic()
            outcome = _watch(rack, seconds, display, _ears(sources, rack.segment, log))
            wall_s, segment = time.monotonic() - started, rack.segment
        rack.close()
        recording = recorder.finish() if recorder is not None else "none"
        _hear(sources, segment, log)
        skipped = segment.words[System.CLOCK_SKIPPED]
        result = RunResult(
            rack=config.name,
            outcome=outcome,
            wall_s=wall_s,
            clock_skipped=skipped,
            tasks=_counters(segment),
            recording=recording,
            faults=strikes(segment, config.robot.joints if config.robot is not None else (), ()),
            clock_offset_ns=time.time_ns() - time.monotonic_ns(),
        )
        log.end(result.document())
    return result


def _watch(rack: Rack, seconds: float | None, display: Display, hear: Callable[[], None]) -> Outcome:
    rack.start(seconds)
    viewer = Viewer(rack.segment)
    while rack.watch(display.period_s):
        display.show(viewer.look())
        hear()
    display.show(viewer.look())
    if rack.outcome is None:
        raise Failure("the run ended without an outcome")
    return rack.outcome


def _window(port: int) -> Callable[[], list[str]]:
    """Open the viewer on what the recorder serves; return what tells of it. Without one the rack runs all the same."""
    try:
        return Window(url(port)).told
    except Failure as failure:
        told = [f"no viewer: {failure}"]
        return lambda: [told.pop()] if told else []


def _ears(sources: list[Callable[[], list[str]]], segment: Segment, log: EventLog) -> Callable[[], None]:
    """Return what makes events of all that only the host side sees."""
    standstill = Standstill(segment)

    def hear() -> None:
        _hear(sources, segment, log)
        for event in standstill.look():
            log.add(event)

    return hear


def _hear(sources: list[Callable[[], list[str]]], segment: Segment, log: EventLog) -> None:
    """Make events of what the recorder and its viewer have to say."""
    for text in [text for told in sources for text in told()]:
        log.add(Event(time.time_ns(), segment.words[System.TICK], "recorder", "", text))


@contextmanager
def _recorder(folder: Path | None) -> Iterator[RecorderProcess | None]:
    recorder = RecorderProcess() if folder is not None else None
    try:
        yield recorder
    finally:
        if recorder is not None:
            recorder.finish()


def _counters(segment: Segment) -> dict[str, dict[str, int]]:
    return {
        task.name: {name.lower(): segment.block(task.name)[Block[name]] for name in COUNTED}
        for task in segment.layout.tasks
    }
