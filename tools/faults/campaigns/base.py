"""The faultless run in lockstep from which trials go on.

Until its first fault a trial is this run, bit for bit. So it starts at the last checkpoint before
that, with the events until then, and its verdict is that of a whole trial.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

from rack.boards.checkpoint.format import FOLDER, checkpoints
from rack.boards.checkpoint.taking import outside
from rack.boards.config.schema import RackConfig
from rack.boards.errors import UNKEPT
from rack.boards.events import Event
from rack.boards.wiring import Keeping
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.recording.checksums import checked_line, read_line

EVERY_S = 2.0
"""Simulated time between two checkpoints. For NASREM's rack going on from one takes about as much
processor time as simulating this long, and keeping one a tenth of that."""
EVENTS = "events.jsonl"
OF_LAUNCH = ("launch", "ready", "start")
"""Kinds of events that each launch has anew."""


@dataclass(frozen=True)
class Start:
    """Where a trial starts: before `tick`, with the `events` until then.

    `whole` says why it starts at its beginning; empty for one that does not, and for the faultless
    run.
    """

    tick: int = 0
    whole: str = ""
    keeping: Keeping | None = None
    events: tuple[Event, ...] = ()


class BaseRun:
    """The run, in a folder that is there as long as the context.

    Processes that make trials have one each, on the same folder.
    """

    def __init__(self, config: RackConfig, folder: Path) -> None:
        self.folder = folder.resolve()
        self._config = config
        self._why_none = ""

    def __enter__(self) -> Self:
        # A campaign that was killed has left one, perhaps of other code.
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        return self

    def __exit__(self, *error: object) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def start_of(self, plan: Plan) -> Start:
        """Return where the trial of a plan starts. The faultless run itself keeps checkpoints."""
        if not plan.lockstep:
            return Start(whole="real time")
        if plan.purpose == "nominal":
            every = max(1, round(EVERY_S * 1e9 / self._config.clock_ns))
            keeping = Keeping(self.folder / FOLDER, every)
            return Start(keeping=None if outside(self._config) else keeping)
        kept = self._kept
        if self._why_none or not kept:
            return Start(whole=f"{UNKEPT}{self._why_none or self._why_not_kept}")
        tick = max((at for at in kept if at <= plan.first), default=0)
        if not tick:
            early = f"first fault at tick {plan.first}, first checkpoint at {min(kept)}"
            return Start(whole=early)
        keeping = Keeping(
            origin=kept[tick],
            packages=self._config.python_path,
            faults=len(self._config.fault),
            commands=len(self._config.command),
        )
        before = (event for event in self._events if event.tick < tick)
        return Start(tick, "", keeping, tuple(e for e in before if e.kind not in OF_LAUNCH))

    def give_up(self, why: str) -> None:
        """Have all trials start at their beginning: the rack cannot continue."""
        self._why_none = why

    def keep(self, events: Sequence[Event]) -> None:
        """Keep the events of the run that has been made."""
        (self.folder / EVENTS).write_text("".join(checked_line(asdict(one)) for one in events))

    @cached_property
    def _kept(self) -> dict[int, Path]:
        return checkpoints(self.folder)

    @cached_property
    def _events(self) -> tuple[Event, ...]:
        lines = (self.folder / EVENTS).read_text().splitlines()
        return tuple(Event(**read_line(line)) for line in lines)

    @cached_property
    def _why_not_kept(self) -> str:
        found = (e.text.removeprefix(UNKEPT) for e in self._events if e.text.startswith(UNKEPT))
        return outside(self._config) or next(found, "the run is too short")
