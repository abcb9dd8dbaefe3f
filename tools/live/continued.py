"""`rack run --from RUN@TIME`, and the state of a run at any tick.

Between two checkpoints the rack goes on from the earlier one, unchanged, to the tick, and keeps its
state there. That is what a branch begins from: only there may it differ.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

import numpy as np

from rack.backplane.address_map import OPERATOR_ENTRIES
from rack.backplane.mailbox.history import chains
from rack.backplane.operator_table import Request
from rack.backplane.segment import Segment
from rack.boards import Rack
from rack.boards.checkpoint.format import ATTRIBUTES, NAME, checkpoints
from rack.boards.checkpoint.taking import outside
from rack.boards.classes import extend_path
from rack.boards.config.resolved import load
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import CrateLine
from rack.boards.wiring import Entries, Keeping
from rack.tools.console.answer import Document, Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.live.launch import Beginning
from rack.tools.recording.divergence import ticks_of
from rack.tools.recording.entries import commands_from, recorded_commands, recorded_entries
from rack.tools.recording.origin import Origin
from rack.tools.recording.parquet import CONFIG
from rack.tools.recording.recording import Recording

MOST_STATES = 64
NO_STATES: Mapping[int, Path] = {}
WHY_NOT = (
    "the code of a level has changed since, it missed cycles in real time, or somebody injected a"
    " fault or stopped it while it ran"
)


def run_of(origin: str) -> Path:
    """Return the config of the run in RUN@TIME. Raises `Failure`."""
    run, at, _ = origin.rpartition("@")
    path = Path(run) / CONFIG
    if not at:
        raise Failure(f"--from {origin}: permitted: RUN@TIME, as in runs/nasrem-1@12.5", 2)
    if not path.is_file():
        raise Failure(f"--from {origin}: {run or '.'} is not a run: it has no {CONFIG}", 2)
    return path


@dataclass(frozen=True)
class RunState:
    """The state of a run before a tick: what a rack goes on from and, if asked for, the attributes
    of its levels, by task."""

    begins: Beginning
    attributes: Mapping[str, Document] = field(default_factory=dict)


class KeptStates:
    """States of a run that were found on the way, to go on from. Their files have no names: however
    this process ends, nothing is left. Boards open them by this process's descriptors."""

    def __init__(self) -> None:
        self._files: dict[int, BinaryIO] = {}

    def keep(self, tick: int, path: Path) -> Path:
        """Take the file of a checkpoint, in a folder that will be removed; return where it is now.
        The oldest of too many goes."""
        if (before := self._files.pop(tick, None)) is not None:
            before.close()
        if len(self._files) == MOST_STATES:
            self._files.pop(next(iter(self._files))).close()
        self._files[tick] = path.open("rb")
        return self.found[tick]

    @property
    def found(self) -> dict[int, Path]:
        """Those that are here, by tick."""
        pid = os.getpid()
        return {tick: Path(f"/proc/{pid}/fd/{f.fileno()}") for tick, f in self._files.items()}

    def close(self) -> None:
        """Let go of all."""
        for file in self._files.values():
            file.close()
        self._files.clear()


@contextmanager
def beginning(config: RackConfig, origin: str) -> Iterator[Beginning]:
    """Yield what a rack with this config, a branch perhaps, goes on from at RUN@TIME, for as long
    as it runs. Raises `Failure`."""
    recording = Recording(run_of(origin).parent)
    asked = f"--from {origin}"
    tick = tick_in(recording, origin.rpartition("@")[2], f"{asked}: ")
    with state_at(recording, tick, asked=asked) as state:
        if state.begins.entries is not None:
            lan = config.adapter.lan
            senders = ", ".join(map(repr, (*config.host, *(() if lan is None else lan.racks))))
            why = f"not started: {senders}; what they sent enters again"
            print(f"{asked}: {why}", file=sys.stderr)
        checkpoint = state.begins.checkpoint
        if checkpoint is not None:
            checkpoint = replace(checkpoint, packages=config.python_path)
        yield replace(state.begins, checkpoint=checkpoint)


@contextmanager
def state_at(
    recording: Recording,
    tick: int,
    *,
    asked: str = "",
    shows: bool = False,
    crate: CrateLine | None = None,
    states: KeptStates | None = None,
) -> Iterator[RunState]:
    """Yield the state of a run before `tick`, for as long as a rack runs that continues from it;
    with `shows`, with the attributes of its levels.

    A `crate` that was started earlier saves time, as do `states` found before; this one joins them.
    A state that is not that of the recording is noted on stderr. Raises `Failure`, which begins
    with what was `asked`.
    """
    asked = asked or f"{recording.folder}@{tick * recording.layout.clock_ns * 1e-9:g}"
    found = {} if states is None else states.found
    begins, before = begun_before(recording, tick, asked, found)
    this = Origin.at(recording, tick)
    if begins == tick and not shows:
        yield RunState(replace(before, origin=this))
        return
    with ExitStack() as stack:
        if states is None:
            states = stack.enter_context(closing(KeptStates()))
        with INTERRUPT.raising(), TemporaryDirectory(prefix="rack-") as folder:
            path = Path(folder)
            kept = replace(before.checkpoint or Keeping(), folder=path, at=tick, shows=shows)
            with gone_on(recording, replace(before, checkpoint=kept), tick, asked, crate) as rack:
                if differing := unlike_in(recording, rack.segment, tick):
                    names = ", ".join(differing)
                    print(f"{asked}: {names} are not as recorded: {WHY_NOT}", file=sys.stderr)
            origin = states.keep(tick, path / NAME.format(tick))
            attributes = attributes_in(path)
        kept_there = _kept_in(recording, origin, tick)
        yield RunState(Beginning(kept_there, entries=before.entries, origin=this), attributes)


def tick_in(recording: Recording, text: str, asked: str = "") -> int:
    """Return the tick of a time, s, in a recorded run. Raises `Failure`, which begins with what was
    `asked`, for one outside, or between two stretches that were kept."""
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


def branched(recording: Recording, settings: Sequence[str], faults: str | None) -> RackConfig:
    """Return the config of a branch of a run in lockstep. Raises `ConfigError`."""
    overrides = ["clock.mode=lockstep", "clock.speed=1.0", *settings]
    return load(str(recording.folder / CONFIG), overrides, faults)


def begun_before(
    recording: Recording, tick: int, asked: str, found: Mapping[int, Path] = NO_STATES
) -> tuple[int, Beginning]:
    """Return the last checkpoint at `tick` or before, of the run or else `found`, or tick 0 without
    one, and what goes on from there, with what operators commanded later. Raises `Failure`."""
    # The rack is about to run again, with the levels that its config names.
    extend_path(recording.rack_config.python_path)
    kept = {at: path.resolve() for at, path in checkpoints(recording.folder).items()}
    if begins := max((at for at in (*kept, *found) if at <= tick), default=0):
        keeping = _kept_in(recording, kept.get(begins) or found[begins], begins)
        entries = _entered(recording, asked)
        return begins, Beginning(keeping, _commanded(recording, begins, asked), entries)
    if ticks_of(recording)[0] > max(task.every for task in recording.layout.tasks):
        # Of a run that goes on from another the beginning is that other's.
        if not kept:
            raise Failure(f"{asked}: it continues another run, and has no checkpoints", 2)
        first = min(kept) * recording.layout.clock_ns * 1e-9
        raise Failure(f"{asked}: permitted: from its first checkpoint, {first:g} s, on", 2)
    commands = recorded_commands(recording)
    entries = _entered(recording, asked)
    if not kept:
        injected = len(recording.ended.get("faults", ())) - len(recording.rack_config.fault)
        without = f", without {injected} faults injected meanwhile" if injected > 0 else ""
        print(
            f"{asked}: {recording.folder} has no checkpoints: it is repeated in lockstep from its"
            f" beginning, with {len(commands)} commands of its operators{without}",
            file=sys.stderr,
        )
    return 0, Beginning(requests=commands, entries=entries)


def _entered(recording: Recording, asked: str) -> Mapping[str, Entries] | None:
    """Return what host boards and other racks sent in a run; None: its rack has none. Raises
    `Failure`."""
    config = recording.rack_config
    return recorded_entries(config, recording.folder, asked) if outside(config) else None


def _commanded(recording: Recording, begins: int, asked: str) -> tuple[Request, ...]:
    """Return the commands from a checkpoint on that find room in the operator table; note on stderr
    those that do not."""
    commands = commands_from(recording, begins)
    room = OPERATOR_ENTRIES - len(recording.rack_config.command)
    if left := commands[room:]:
        since_s = left[0].tick * recording.layout.clock_ns * 1e-9
        why = f"the operator table holds {OPERATOR_ENTRIES}"
        print(f"{asked}: commands from {since_s:g} s on are not repeated: {why}", file=sys.stderr)
    return commands[:room]


def _kept_in(recording: Recording, origin: Path, tick: int) -> Keeping:
    """Return what goes on from the state of a run at `tick`, in this file."""
    ran = recording.rack_config
    died = (event for event in recording.events if event["kind"] == "died")
    return Keeping(
        origin=origin,
        packages=ran.python_path,
        faults=len(ran.fault),
        commands=len(ran.command),
        losses=tuple((one["board"], one["tick"]) for one in died if one["tick"] < tick),
    )


@contextmanager
def gone_on(
    recording: Recording,
    begins: Beginning,
    until: int,
    asked: str,
    crate: CrateLine | None = None,
) -> Iterator[Rack]:
    """Let the rack of a run go on, unchanged, to tick `until`; yield it as it is then. Raises
    `Failure` if its state was to be kept on the way, and is not."""
    keeping = begins.checkpoint
    ran = branched(recording, (), None)
    # The run's own name may be in use.
    config = ran.model_copy(update={"name": f"{ran.name[:16]}-at-{until}-{os.getpid()}"})
    with Rack(
        config,
        crate=crate,
        entries=begins.entries,
        keeping=keeping,
        requests=begins.requests,
        repeats=ran.name,
    ) as rack:
        rack.run(until * config.clock_ns * 1e-9)
        at = None if keeping is None else keeping.at
        if (
            keeping is not None
            and at is not None
            and not (keeping.folder / NAME.format(at)).is_file()
        ):
            printed = [event.text for event in rack.events if event.kind == "printed"]
            why = (
                printed[-1]
                if printed
                else "a board is lost then; ask for a time at which it is back"
            )
            raise Failure(f"{asked}: {why}", 2)
        yield rack


def attributes_in(folder: Path) -> dict[str, Document]:
    """Return the attributes of levels next to a checkpoint, by task."""
    return {found.stem: json.loads(found.read_bytes()) for found in folder.glob(f"*{ATTRIBUTES}")}


def unlike_in(recording: Recording, segment: Segment, tick: int) -> list[str]:
    """Return the mailboxes whose messages until `tick` are not those of the recording."""
    found = []
    for name, (serial, chain) in chains(segment, tick).items():
        # Each message carries the chain of those before it.
        at = np.flatnonzero(recording.signal(name, "serial") == serial + 1)
        if len(at) and recording.signal(name, "chain")[at[0]] != chain:
            found.append(name)
    return found
