"""A recorded run, run again in lockstep with snapshots on the way: `rack run --from RUN@TIME`, and
the state of a run at any tick.

Lockstep is deterministic, so the rack of the run comes to each tick as it did then. What operators
commanded enters again, and what host boards and other racks sent. Until the tick it goes on
unchanged: only there may a branch differ.
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


class RunAgain:
    """The rack of a recorded run, which runs again to any tick. Use it as a context: its snapshots
    end with it, and with its `crate`.

    Each tick that was reached has a snapshot, from which later ones are near. A run that continues
    another one begins with that. `asked` begins what goes wrong, which is a `Failure`. `anyway`:
    even if its code or files have changed since.
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
        # The rack is about to run again, with the levels that its config names.
        extend_path(ran.python_path)
        check_code(recording, self._asked, anyway)
        self.crate = crate or WarmCrate()
        # It imports while this process reads the run.
        self.crate.ask(Preload(classes(ran), tuple(sys.path), cell_of(ran)))
        self._has_begun = False
        self._branched_at = continued_at(recording)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.crate.end()

    @cached_property
    def _parent(self) -> RunAgain | None:
        """The run that this one continues."""
        if self._branched_at is None:
            return None
        folder = other_run(self.recording.folder, Path("origin"), self._asked)
        return RunAgain(Recording(folder), self._asked, self.crate, self._anyway)

    @cached_property
    def entries(self) -> Mapping[str, Entries] | None:
        """What host boards and other racks sent in the run; None: its rack has none."""
        run = self.recording
        config = run.rack_config
        return recorded_entries(config, run.folder, self._asked) if config.outside else None

    def reach(self, tick: int) -> None:
        """Have a snapshot before `tick`, in which all is as it was in the run then; note on stderr
        what is not. Raises `Failure`.
        """
        if not self._has_begun and self._branched_at not in (None, tick):
            # From here on all snapshots are of this run, not of the one that it continues.
            self.reach(self._branched_at or 0)
        if self._has_begun and self._nearest(tick) == tick:
            return
        with self.rack_at(tick, SnapshotPolicy(at=tick)) as rack:
            if unlike := unlike_in(self.recording, rack.segment, tick):
                self._note_unlike(unlike, tick)
            said = [e.text for e in rack.events if e.kind == "printed" or e.text.startswith(UNKEPT)]
        if self._nearest(tick) != tick:
            why = said[-1] if said else "a board is lost then; ask for a time at which it is back"
            raise Failure(f"{self._asked}: {why}", 2)

    @contextmanager
    def rack_at(self, tick: int, snapshots: SnapshotPolicy | None = None) -> Iterator[Rack]:
        """Yield the rack as it is when it has run, unchanged, to `tick`."""
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
        """Return the run's own config, with another name: that may be in use."""
        config = branched(self.recording)
        return config.model_copy(update={"name": f"{config.name[:16]}-{ending}-{os.getpid()}"})

    def beginning(self, tick: int) -> Beginning:
        """Return what a rack goes on from at `tick`."""
        self.reach(tick)
        return replace(self._begin(tick), origin=Origin.at(self.recording, tick))

    def levels(self, tick: int) -> dict[str, Document]:
        """Return the attributes of the levels' own objects before `tick`, by task."""
        self.reach(tick)
        tasks = [task.name for task in self.recording.layout.tasks]
        shown = {task: self.crate.show(tick, task).attributes for task in tasks}
        return {task: json.loads(text) for task, text in shown.items() if text}

    def _begin(self, tick: int) -> Beginning:
        """Return what the run's own rack goes on from to come to `tick`."""
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
            raise Failure(f"{self._asked}: its beginning was not kept", 2)
        return replace(begins, requests=recorded_commands(run))

    def _continuation(self, tick: int) -> Continuation:
        """Return the snapshot at `tick` or before, with what the tables hold there."""
        ran = self.recording.rack_config
        return Continuation(tick, len(ran.fault), len(ran.command), self._losses)

    @cached_property
    def _losses(self) -> tuple[tuple[str, int], ...]:
        died = (event for event in self.recording.events if event["kind"] == "died")
        earlier = () if self._parent is None else self._parent._losses
        before = (loss for loss in earlier if loss[1] < (self._branched_at or 0))
        return (*before, *((one["board"], one["tick"]) for one in died))

    def _nearest(self, tick: int) -> int:
        return self.crate.show(tick, "").tick

    def _note_unlike(self, unlike: Sequence[str], tick: int) -> None:
        """Note what is not as recorded, with the first message and field that differ."""
        names = ", ".join(unlike)
        first = ""
        with suppress(Failure), TemporaryDirectory(prefix="rack-") as folder:
            first = f"{self._first_unlike(Path(folder) / 'again', tick)}: "
        print(f"{self._asked}: {names} are not as recorded: {first}{WHY_NOT}", file=sys.stderr)

    def _first_unlike(self, folder: Path, tick: int) -> str:
        """Return the first message that differs until `tick`, as text, from a record of the rack
        that runs again into `folder`.
        """
        config = self._own_config("again")
        begins = self._begin(self._branched_at or 0)
        run_rack(config, tick * config.clock_ns * 1e-9, folder, Display(), begins=begins)
        again = Recording(folder)
        first = unlike_messages(self.recording, again)[0]
        box = again.layout.mailbox(first.mailbox)
        was, now = (row_of(run, box, first.serial) for run in (self.recording, again))
        where = f"first {box.name} at tick {first.tick}"
        if was is None or now is None:
            return f"{where}, which one of the two lacks"
        was, now = was["message"], now["message"]
        names = [field.name for field in box.fields]
        unlike = [name for name in names if not np.array_equal(was[name], now[name])]
        return ", ".join((where, *(f"{name} was {was[name]}, is {now[name]}" for name in unlike)))


def run_of(origin: str) -> Path:
    """Return the config of the run in RUN@TIME. Raises `Failure`."""
    run, at, _ = origin.rpartition("@")
    path = Path(run) / CONFIG
    if not at:
        raise Failure(f"--from {origin}: permitted: RUN@TIME, as in runs/nasrem-1@12.5", 2)
    if not path.is_file():
        raise Failure(f"--from {origin}: {run or '.'} is not a run: it has no {CONFIG}", 2)
    return path


@contextmanager
def beginning(
    config: RackConfig, origin: str, crate: WarmCrate | None = None, anyway: bool = False
) -> Iterator[Beginning]:
    """Yield what a rack with this config, a branch perhaps, goes on from at RUN@TIME, for as long
    as it runs. A `crate` that was started earlier saves time. Raises `Failure`.
    """
    recording = Recording(run_of(origin).parent)
    asked = f"--from {origin}"
    tick = tick_in(recording, origin.rpartition("@")[2], f"{asked}: ")
    injected = len(recording.ended.get("faults", ())) - len(recording.rack_config.fault)
    if injected > 0:
        why = "faults were injected while it ran, which is not repeated"
        print(f"{asked}: {injected} {why}", file=sys.stderr)
    with RunAgain(recording, asked, crate, anyway) as again:
        if again.entries is not None:
            lan = config.adapter.lan
            senders = ", ".join(map(repr, (*config.host, *(() if lan is None else lan.racks))))
            why = f"not started: {senders}; what they sent enters again"
            print(f"{asked}: {why}", file=sys.stderr)
        yield again.beginning(tick)


def tick_in(recording: Recording, text: str, asked: str = "") -> int:
    """Return the tick of a time, s, in a recorded run. Raises `Failure`, which begins with what was
    `asked`, for one outside, or between two stretches that were kept.
    """
    tick = -1
    # What is no time is outside, too.
    with suppress(ValueError, OverflowError):
        tick = round(float(text) * 1e9 / recording.layout.clock_ns)
    is_kept = any(first <= tick < end for first, end in recording.kept or [(0, tick + 1)])
    begins, ends = ticks_of(recording)
    if not (begins <= tick < ends and is_kept):
        first, last = (at * recording.layout.clock_ns * 1e-9 for at in (begins, ends - 1))
        kept = f"; {recording.kept_text}" if recording.kept else ""
        raise Failure(f"{asked}{text}: permitted: {first:g} to {last:g} s{kept}", 2)
    return tick


def branched(
    recording: Recording, settings: Sequence[str] = (), faults: str | None = None
) -> RackConfig:
    """Return the config of a branch of a run in lockstep. Raises `ConfigError`."""
    overrides = ["clock.mode=lockstep", "clock.speed=1.0", *settings]
    return load(str(recording.folder / CONFIG), overrides, faults)


def unlike_in(recording: Recording, segment: Segment, tick: int) -> list[str]:
    """Return the mailboxes whose messages until `tick` are not those of the recording."""
    found = []
    for name, (serial, chain) in chains(segment, tick).items():
        # Each message carries the chain of those before it.
        at = np.flatnonzero(recording.signal(name, "serial") == serial + 1)
        if len(at) and recording.signal(name, "chain")[at[0]] != chain:
            found.append(name)
    return found
