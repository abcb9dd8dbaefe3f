"""Repeats a recorded run in lockstep up to any tick, and takes snapshots.

`rack run --from RUN@TIME` and `rack rewind` use it. Lockstep is deterministic, so the rack reaches
each tick in the same state as in the recorded run. Commands of operators are repeated, and messages
of host boards and other racks are replayed. A branch differs from the run only from that tick on.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self

import numpy as np

from rack.backplane.mailbox.history import find_chains
from rack.backplane.segment import Segment
from rack.boards import Rack
from rack.boards.config.loader import extend_path, load
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.boards.crate.rack import build_preload_request
from rack.boards.errors import NO_SNAPSHOTS_PREFIX
from rack.boards.events import OF_LAUNCH, Event
from rack.boards.wiring import Continuation, RecordedEntries, SnapshotPolicy
from rack.tools.console.answer import Document, Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.launch.launch import Beginning, run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.divergence import (
    find_other_run,
    find_row,
    find_tick_range,
    list_divergent_messages,
)
from rack.tools.recording.entries import load_commands_from, load_entries, load_operator_commands
from rack.tools.recording.file_names import CONFIG
from rack.tools.recording.origin import Origin, check_code_state
from rack.tools.recording.recording import Recording

DIFFERENCE_CAUSES = (
    "the code of a level has changed since, it missed cycles in real time, it does not repeat"
    " itself, or somebody injected a fault or stopped it while it ran"
)
"""Possible reasons why a repeated run differs from its recording."""


class RepeatedRun:
    """The rack of a recorded run, which can be repeated up to any tick.

    A snapshot is taken at each tick reached, so that later ticks are reached faster. Ticks before
    the first snapshot are reached from the beginning of the run. If the run continues another run,
    that one is repeated first. Use it as a context: on exit the `crate` and its snapshots end.

    Args:
        recording: The run.
        asked: Prefix of the text of each `Failure`. If empty, the folder of the run is used.
        crate: A crate that was started earlier, to save time.
        anyway: True to repeat the run even if its code or files have changed since.
    """

    def __init__(
        self,
        recording: Recording,
        asked: str = "",
        crate: WarmCrate | None = None,
        anyway: bool = False,
    ) -> None:
        self.recording = recording
        self._error_prefix = asked or str(recording.folder)
        self._anyway = anyway
        ran = recording.rack_config
        # Make the levels that the config names importable.
        extend_path(ran.python_path)
        check_code_state(recording, self._error_prefix, anyway)
        self.crate = crate or WarmCrate()
        # The crate imports the levels while this process reads the run.
        self.crate.try_request(build_preload_request(ran))
        self._has_begun = False
        origin = Origin.read_from(recording)
        self._branched_at = None if origin is None else origin.tick

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.crate.end_crate()

    @cached_property
    def _parent(self) -> RepeatedRun | None:
        """The run that this one continues. None if it starts from the beginning."""
        if self._branched_at is None:
            return None
        folder = find_other_run(self.recording.folder, Path("origin"), self._error_prefix)
        return RepeatedRun(Recording(folder), self._error_prefix, self.crate, self._anyway)

    @cached_property
    def entries(self) -> Mapping[str, RecordedEntries] | None:
        """Messages that host boards and other racks sent in the run.

        None if its rack has neither.
        """
        run = self.recording
        config = run.rack_config
        return (
            load_entries(config, run.folder, self._error_prefix) if config.outside_state else None
        )

    def reach_tick(self, tick: int) -> None:
        """Repeat the run up to `tick`, and take a snapshot before it.

        Differences from the recording are reported on stderr. Raises `Failure` if no snapshot can
        be taken, as when a board is lost at that tick.
        """
        if not self._has_begun and self._branched_at not in (None, tick):
            # First reach the branching tick, so that all later snapshots belong to this run.
            self.reach_tick(self._branched_at or 0)
        if self._has_begun and self._nearest_snapshot_tick(tick) == tick:
            return
        with self.run_rack_to(tick, SnapshotPolicy(at=tick)) as rack:
            if differing := list_differing_mailboxes(self.recording, rack.segment, tick):
                print(
                    f"{self._error_prefix}: {', '.join(differing)} are not as recorded:"
                    f" {self._find_first_difference(tick)}{DIFFERENCE_CAUSES}",
                    file=sys.stderr,
                )
            notes = [
                e.text
                for e in rack.events
                if e.kind == "printed" or e.text.startswith(NO_SNAPSHOTS_PREFIX)
            ]
        if self._nearest_snapshot_tick(tick) != tick:
            why = (
                notes[-1]
                if notes
                else "a board is lost at this time; choose a time when it is back"
            )
            raise Failure(f"{self._error_prefix}: {why}", 2)

    @contextmanager
    def run_rack_to(self, tick: int, snapshots: SnapshotPolicy | None = None) -> Iterator[Rack]:
        """Provide the rack after an unchanged run up to `tick`.

        Args:
            tick: The tick before which the rack stops.
            snapshots: Which snapshots to keep. None for none.
        """
        begins = self._find_beginning(tick)
        config = self._unique_config(f"at-{tick}")
        with (
            INTERRUPT.raise_interrupted(),
            Rack(
                config,
                crate=self.crate,
                entries=begins.entries,
                snapshots=snapshots,
                continues=begins.continues,
                requests=begins.requests,
                repeats=self.recording.rack_config.name,
            ) as rack,
        ):
            rack.run(tick * config.clock_ns * 1e-9)
            self._has_begun = True
            yield rack

    def _unique_config(self, ending: str) -> RackConfig:
        """Return the run's config under a unique name, because its own name may be in use."""
        config = load_branch_config(self.recording)
        return config.model_copy(update={"name": f"{config.name[:16]}-{ending}-{os.getpid()}"})

    def continue_at(self, tick: int) -> Beginning:
        """Return the state from which a rack can continue at `tick`."""
        self.reach_tick(tick)
        run = self.recording
        events = (*run.end_counts.get("earlier", ()), *run.events)
        earlier = (Event(**event) for event in events if 0 <= event.get("tick", -1) < tick)
        return replace(
            self._find_beginning(tick),
            origin=Origin(str(run.folder), tick, run.launch.created_ns),
            earlier=tuple(event for event in earlier if event.kind not in OF_LAUNCH),
        )

    def read_levels(self, tick: int) -> dict[str, Document]:
        """Return a dictionary from task to the attributes of its level's object before `tick`."""
        self.reach_tick(tick)
        tasks = [task.name for task in self.recording.layout.tasks]
        texts = {task: self.crate.read_attributes(tick, task).attributes for task in tasks}
        return {task: json.loads(text) for task, text in texts.items() if text}

    def _find_beginning(self, tick: int) -> Beginning:
        """Return the nearest state from which the run can be repeated towards `tick`."""
        run = self.recording
        begins = Beginning(crate=self.crate, entries=self.entries)
        if self._has_begun and self._nearest_snapshot_tick(tick) >= 0:
            return replace(begins, continues=self._find_continuation(tick))
        if self._branched_at is not None and self._parent is not None:
            self._parent.reach_tick(self._branched_at)
            continues = self._parent._find_continuation(self._branched_at)
            requests = load_commands_from(run, self._branched_at)
            return replace(begins, continues=continues, requests=requests)
        if find_tick_range(run)[0] > max(task.every for task in run.layout.tasks):
            raise Failure(f"{self._error_prefix}: the beginning of the run was not recorded", 2)
        return replace(begins, requests=load_operator_commands(run))

    def _find_continuation(self, tick: int) -> Continuation:
        """Return the point from which a rack continues: the newest snapshot at or before `tick`.

        The snapshot already contains the faults and commands of the config. The result includes
        their numbers.
        """
        ran = self.recording.rack_config
        return Continuation(tick, len(ran.fault), len(ran.command), self._losses)

    @cached_property
    def _losses(self) -> tuple[tuple[str, int], ...]:
        """Boards that died in this run or in one that it continues, each with the tick of death."""
        died = (event for event in self.recording.events if event["kind"] == "died")
        earlier = () if self._parent is None else self._parent._losses
        before = (loss for loss in earlier if loss[1] < (self._branched_at or 0))
        return (*before, *((death["board"], death["tick"]) for death in died))

    def _nearest_snapshot_tick(self, tick: int) -> int:
        """Return the tick of the newest snapshot at or before `tick`."""
        return self.crate.read_attributes(tick, "").tick

    def _find_first_difference(self, tick: int) -> str:
        """Repeat the run up to `tick`, and describe its first message that differs.

        Returns:
            A clause. Empty if the run cannot be recorded again, or if no message differs.
        """
        config = self._unique_config("again")
        begins = self._find_beginning(self._branched_at or 0)
        with suppress(Failure), TemporaryDirectory(prefix="rack-") as name:
            folder = Path(name) / "again"
            run_rack(config, tick * config.clock_ns * 1e-9, folder, Display(), beginning=begins)
            runs = self.recording, Recording(folder)
            differing = list_divergent_messages(*runs)
            if not differing:
                return ""
            first = differing[0]
            box = self.recording.layout.find_mailbox(first.mailbox)
            recorded, repeated = (find_row(run, box, first.serial) for run in runs)
            where = f"first {box.name} at tick {first.tick}"
            if recorded is None or repeated is None:
                return f"{where}, which is missing in one of the two runs: "
            names = [field.name for field in box.fields]
            pairs = [(n, recorded["message"][n], repeated["message"][n]) for n in names]
            fields = [f"{n} was {a}, is {b}" for n, a, b in pairs if not np.array_equal(a, b)]
            return f"{', '.join((where, *fields))}: "
        return ""


def find_run_config(origin: str) -> Path:
    """Find the config of the run in RUN@TIME. Raises `Failure`."""
    run, at, _ = origin.rpartition("@")
    path = Path(run) / CONFIG
    if not at:
        raise Failure(f"--from {origin}: must be RUN@TIME, as in runs/nasrem-1@12.5", 2)
    if not path.is_file():
        raise Failure(f"--from {origin}: {run or '.'} is not a run: it has no {CONFIG}", 2)
    return path


@contextmanager
def open_beginning(
    config: RackConfig, origin: str, crate: WarmCrate | None, anyway: bool
) -> Iterator[Beginning]:
    """Provide a state of a recorded run from which a rack can continue, valid inside the context.

    Args:
        config: Config of the rack, which may be a branch of the run.
        origin: The run and the time, as RUN@TIME.
        crate: A crate that was started earlier, to save time.
        anyway: True to repeat the run even if its code or files have changed since.

    Raises:
        Failure: The run cannot be repeated up to this time.
    """
    recording = Recording(find_run_config(origin).parent)
    asked = f"--from {origin}"
    tick = parse_tick(recording, origin.rpartition("@")[2], f"{asked}: ")
    injected = len(recording.end_counts.get("faults", ())) - len(recording.rack_config.fault)
    if injected > 0:
        why = "faults were injected by hand during the run and are not repeated"
        print(f"{asked}: {injected} {why}", file=sys.stderr)
    with RepeatedRun(recording, asked, crate, anyway) as again:
        if again.entries is not None:
            lan = config.adapter.lan
            senders = ", ".join(map(repr, (*config.host, *(() if lan is None else lan.racks))))
            why = f"not started: {senders}; their recorded messages are replayed"
            print(f"{asked}: {why}", file=sys.stderr)
        yield again.continue_at(tick)


def parse_tick(recording: Recording, text: str, asked: str = "") -> int:
    """Convert a time in s to a tick of a recorded run.

    Args:
        recording: The run.
        text: The time.
        asked: Prefix of the text of the `Failure`.

    Raises:
        Failure: The time is not a number, outside the run, or between two recorded stretches.
    """
    tick = -1
    # Text that is not a number is treated as a time outside the run.
    with suppress(ValueError, OverflowError):
        tick = recording.layout.to_ticks(float(text))
    is_kept = any(first <= tick < end for first, end in recording.kept or [(0, tick + 1)])
    begins, ends = find_tick_range(recording)
    if not (begins <= tick < ends and is_kept):
        first, last = (at * recording.layout.clock_ns * 1e-9 for at in (begins, ends - 1))
        suffix = f"; {recording.kept_text}" if recording.kept else ""
        raise Failure(f"{asked}{text}: must be {first:g} to {last:g} s{suffix}", 2)
    return tick


def load_branch_config(
    recording: Recording, settings: Sequence[str] = (), faults: str | None = None
) -> RackConfig:
    """Load the config of a branch of a run, in lockstep.

    Args:
        recording: The run.
        settings: Changed values, as KEY=VALUE.
        faults: A fault script by name or path, or None.

    Raises:
        ConfigError: The changed config has mistakes.
    """
    overrides = ["clock.mode=lockstep", "clock.speed=1.0", *settings]
    return load(str(recording.folder / CONFIG), overrides, faults)


def list_differing_mailboxes(recording: Recording, segment: Segment, tick: int) -> list[str]:
    """List the mailboxes whose messages up to `tick` differ from those of the recording."""
    differing = []
    for name, (serial, chain) in find_chains(segment, tick).items():
        # The chained checksum of a message covers all messages before it.
        rows = np.flatnonzero(recording.read_signal(name, "serial") == serial + 1)
        if len(rows) and recording.read_signal(name, "chain")[rows[0]] != chain:
            differing.append(name)
    return differing
