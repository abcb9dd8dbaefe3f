"""Runs a recorded run again in lockstep, up to any tick, with snapshots on the way.

`rack run --from RUN@TIME` and `rack rewind` use it. Lockstep is deterministic, so the rack comes to
each tick in the same state as in the recorded run. Commands of operators are repeated, and messages
of host boards and other racks are replayed. Up to the tick nothing is changed: a branch may differ
only from there.
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

from rack.backplane.mailbox.history import chains
from rack.backplane.segment import Segment
from rack.boards import Rack
from rack.boards.classes import extend_path
from rack.boards.config.loader import load
from rack.boards.config.resolved import classes
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.boards.crate.rack import cell_of
from rack.boards.crate.requests import Preload
from rack.boards.errors import UNKEPT
from rack.boards.wiring import Continuation, Entries, SnapshotPolicy
from rack.tools.console.answer import Document, Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.launch.launch import Beginning, run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.divergence import other_run, row_of, ticks_of, unlike_messages
from rack.tools.recording.entries import commands_from, recorded_commands, recorded_entries
from rack.tools.recording.file_names import CONFIG
from rack.tools.recording.origin import Origin, check_code, continued_at
from rack.tools.recording.recording import Recording

WHY_NOT = (
    "the code of a level has changed since, it missed cycles in real time, it does not repeat"
    " itself, or somebody injected a fault or stopped it while it ran"
)
"""Possible reasons why a repeated run differs from its recording."""


class RunAgain:
    """The rack of a recorded run, which is repeated up to any tick.

    Each tick that was reached has a snapshot, from which later ticks are near. A run that continues
    another run first repeats that one. Use it as a context: its snapshots and its `crate` end with
    it.

    Args:
        recording: The run.
        asked: Beginning of the text of each `Failure`. Empty for the folder of the run.
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
        self._asked = asked or str(recording.folder)
        self._anyway = anyway
        ran = recording.rack_config
        # Make the levels that the config names importable.
        extend_path(ran.python_path)
        check_code(recording, self._asked, anyway)
        self.crate = crate or WarmCrate()
        # The crate imports them while this process reads the run.
        self.crate.ask(Preload(classes(ran), tuple(sys.path), cell_of(ran)))
        self._has_begun = False
        self._branched_at = continued_at(recording)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.crate.end()

    @cached_property
    def _parent(self) -> RunAgain | None:
        """The run that this one continues. None if it starts from the beginning."""
        if self._branched_at is None:
            return None
        folder = other_run(self.recording.folder, Path("origin"), self._asked)
        return RunAgain(Recording(folder), self._asked, self.crate, self._anyway)

    @cached_property
    def entries(self) -> Mapping[str, Entries] | None:
        """Messages that host boards and other racks sent in the run.

        None if its rack has neither.
        """
        run = self.recording
        config = run.rack_config
        return recorded_entries(config, run.folder, self._asked) if config.outside else None

    def reach(self, tick: int) -> None:
        """Make a snapshot before `tick`. Differences from the recording are noted on stderr.

        Raises `Failure` if there is none, because a board is lost at that tick.
        """
        if not self._has_begun and self._branched_at not in (None, tick):
            # First reach the branching tick, so that all later snapshots belong to this run.
            self.reach(self._branched_at or 0)
        if self._has_begun and self._nearest(tick) == tick:
            return
        with self.rack_at(tick, SnapshotPolicy(at=tick)) as rack:
            if differing := unlike_in(self.recording, rack.segment, tick):
                self._note_unlike(differing, tick)
            notes = [
                e.text for e in rack.events if e.kind == "printed" or e.text.startswith(UNKEPT)
            ]
        if self._nearest(tick) != tick:
            why = (
                notes[-1]
                if notes
                else "a board is lost at this time; choose a time when it is back"
            )
            raise Failure(f"{self._asked}: {why}", 2)

    @contextmanager
    def rack_at(self, tick: int, snapshots: SnapshotPolicy | None = None) -> Iterator[Rack]:
        """Yield the rack after it has run, unchanged, up to `tick`.

        Args:
            tick: The tick before which the rack stops.
            snapshots: Which snapshots to keep. None for none.
        """
        begins = self._begin(tick)
        config = self._own_config(f"at-{tick}")
        with (
            INTERRUPT.raising(),
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

    def _own_config(self, ending: str) -> RackConfig:
        """Return the config of the run with a unique name, since the original may be in use."""
        config = branched(self.recording)
        return config.model_copy(update={"name": f"{config.name[:16]}-{ending}-{os.getpid()}"})

    def beginning(self, tick: int) -> Beginning:
        """Return the state from which a rack can continue at `tick`."""
        self.reach(tick)
        return replace(self._begin(tick), origin=Origin.at(self.recording, tick))

    def levels(self, tick: int) -> dict[str, Document]:
        """Return the attributes of the levels' objects before `tick`, by task."""
        self.reach(tick)
        tasks = [task.name for task in self.recording.layout.tasks]
        texts = {task: self.crate.show(tick, task).attributes for task in tasks}
        return {task: json.loads(text) for task, text in texts.items() if text}

    def _begin(self, tick: int) -> Beginning:
        """Return the state from which this run is repeated towards `tick`."""
        run = self.recording
        begins = Beginning(crate=self.crate, entries=self.entries)
        if self._has_begun:
            return replace(begins, continues=self._continuation(tick))
        if self._branched_at is not None and self._parent is not None:
            self._parent.reach(self._branched_at)
            continues = self._parent._continuation(self._branched_at)
            requests = commands_from(run, self._branched_at)
            return replace(begins, continues=continues, requests=requests)
        if ticks_of(run)[0] > max(task.every for task in run.layout.tasks):
            raise Failure(f"{self._asked}: the beginning of the run was not recorded", 2)
        return replace(begins, requests=recorded_commands(run))

    def _continuation(self, tick: int) -> Continuation:
        """Return the newest snapshot up to `tick`, with the number of entries in the tables."""
        ran = self.recording.rack_config
        return Continuation(tick, len(ran.fault), len(ran.command), self._losses)

    @cached_property
    def _losses(self) -> tuple[tuple[str, int], ...]:
        """Boards that died in this run and those it continues, with the ticks."""
        died = (event for event in self.recording.events if event["kind"] == "died")
        earlier = () if self._parent is None else self._parent._losses
        before = (loss for loss in earlier if loss[1] < (self._branched_at or 0))
        return (*before, *((death["board"], death["tick"]) for death in died))

    def _nearest(self, tick: int) -> int:
        """Return the tick of the newest snapshot up to `tick`."""
        return self.crate.show(tick, "").tick

    def _note_unlike(self, unlike: Sequence[str], tick: int) -> None:
        """Report on stderr which mailboxes differ from the recording, with the first difference."""
        names = ", ".join(unlike)
        first = ""
        with suppress(Failure), TemporaryDirectory(prefix="rack-") as folder:
            first = f"{self._first_unlike(Path(folder) / 'again', tick)}: "
        print(f"{self._asked}: {names} are not as recorded: {first}{WHY_NOT}", file=sys.stderr)

    def _first_unlike(self, folder: Path, tick: int) -> str:
        """Describe the first message up to `tick` that differs from the recording.

        The rack runs again for this, and is recorded into `folder`.
        """
        config = self._own_config("again")
        begins = self._begin(self._branched_at or 0)
        run_rack(config, tick * config.clock_ns * 1e-9, folder, Display(), begins=begins)
        again = Recording(folder)
        first = unlike_messages(self.recording, again)[0]
        box = again.layout.mailbox(first.mailbox)
        recorded, repeated = (row_of(run, box, first.serial) for run in (self.recording, again))
        where = f"first {box.name} at tick {first.tick}"
        if recorded is None or repeated is None:
            return f"{where}, which is missing in one of the two runs"
        recorded, repeated = recorded["message"], repeated["message"]
        names = [field.name for field in box.fields]
        differing = [name for name in names if not np.array_equal(recorded[name], repeated[name])]
        return ", ".join(
            (where, *(f"{name} was {recorded[name]}, is {repeated[name]}" for name in differing))
        )


def run_of(origin: str) -> Path:
    """Find the config of the run in RUN@TIME. Raises `Failure`."""
    run, at, _ = origin.rpartition("@")
    path = Path(run) / CONFIG
    if not at:
        raise Failure(f"--from {origin}: must be RUN@TIME, as in runs/nasrem-1@12.5", 2)
    if not path.is_file():
        raise Failure(f"--from {origin}: {run or '.'} is not a run: it has no {CONFIG}", 2)
    return path


@contextmanager
def beginning(
    config: RackConfig, origin: str, crate: WarmCrate | None = None, anyway: bool = False
) -> Iterator[Beginning]:
    """Yield the state of a recorded run from which a rack can continue, valid inside the context.

    Args:
        config: Config of the rack, which may be a branch of the run.
        origin: The run and the time, as RUN@TIME.
        crate: A crate that was started earlier, to save time.
        anyway: True to repeat the run even if its code or files have changed since.

    Raises:
        Failure: The run cannot be repeated up to this time.
    """
    recording = Recording(run_of(origin).parent)
    asked = f"--from {origin}"
    tick = tick_in(recording, origin.rpartition("@")[2], f"{asked}: ")
    injected = len(recording.ended.get("faults", ())) - len(recording.rack_config.fault)
    if injected > 0:
        why = "faults were injected by hand during the run and are not repeated"
        print(f"{asked}: {injected} {why}", file=sys.stderr)
    with RunAgain(recording, asked, crate, anyway) as again:
        if again.entries is not None:
            lan = config.adapter.lan
            senders = ", ".join(map(repr, (*config.host, *(() if lan is None else lan.racks))))
            why = f"not started: {senders}; their recorded messages are replayed"
            print(f"{asked}: {why}", file=sys.stderr)
        yield again.beginning(tick)


def tick_in(recording: Recording, text: str, asked: str = "") -> int:
    """Convert a time, s, to a tick of a recorded run.

    Args:
        recording: The run.
        text: The time.
        asked: Beginning of the text of a `Failure`.

    Raises:
        Failure: The time is outside the run, or between two recorded stretches.
    """
    tick = -1
    # A text that is not a number counts as outside.
    with suppress(ValueError, OverflowError):
        tick = round(float(text) * 1e9 / recording.layout.clock_ns)
    is_kept = any(first <= tick < end for first, end in recording.kept or [(0, tick + 1)])
    begins, ends = ticks_of(recording)
    if not (begins <= tick < ends and is_kept):
        first, last = (at * recording.layout.clock_ns * 1e-9 for at in (begins, ends - 1))
        suffix = f"; {recording.kept_text}" if recording.kept else ""
        raise Failure(f"{asked}{text}: must be {first:g} to {last:g} s{suffix}", 2)
    return tick


def branched(
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


def unlike_in(recording: Recording, segment: Segment, tick: int) -> list[str]:
    """List the mailboxes whose messages up to `tick` differ from those of the recording."""
    differing = []
    for name, (serial, chain) in chains(segment, tick).items():
        # The chained checksum of a message covers all messages before it.
        rows = np.flatnonzero(recording.signal(name, "serial") == serial + 1)
        if len(rows) and recording.signal(name, "chain")[rows[0]] != chain:
            differing.append(name)
    return differing
