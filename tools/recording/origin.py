"""The run that another one goes on from: origin.json in the folder of the later one.

Launching a run needs this, so it imports nothing that reads recordings.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

from rack.backplane.json_text import encode_json
from rack.boards.events import CONTINUES
from rack.tools.console.answer import Document
from rack.tools.recording.checksums import read_file
from rack.tools.recording.recorder_process import ORIGIN

if TYPE_CHECKING:
    from rack.tools.recording.recording import Recording


@dataclass(frozen=True)
class Origin:
    """The run that another one goes on from before `tick`.

    `folder`: as its user named it. `launched_ns`: when it was launched, on the wall clock; no other
    run has that.
    """

    folder: str
    tick: int
    launched_ns: int

    @classmethod
    def at(cls, run: Recording, tick: int) -> Self:
        """Return it for what goes on from a run."""
        return cls(str(run.folder), tick, run.launch.created_ns)

    @classmethod
    def of(cls, recording: Recording) -> Self | None:
        """Return it for a recorded run; None for one that goes on from no other. Raises `Failure`
        for a damaged file."""
        path = recording.folder / ORIGIN
        if not path.exists():
            return None
        recording.checksums.verify(ORIGIN)
        return cls(**json.loads(read_file(path)))

    def is_of(self, run: Recording) -> bool:
        """Return whether it is this run, and no other one of that name."""
        return run.launch.created_ns == self.launched_ns

    def write(self, folder: Path) -> None:
        """Write it into the folder of the later run. Raises `OSError`."""
        (folder / ORIGIN).write_text(encode_json(asdict(self)) + "\n")

    def document(self, clock_ns: int) -> Document:
        """Return it as plain data, with its simulated time, s."""
        return {**asdict(self), "time_s": round(self.tick * clock_ns * 1e-9, 9)}


def continued_at(recording: Recording) -> int | None:
    """Return the tick before which a run that goes on from another begins; None for any other."""
    found = (event["tick"] for event in recording.events if event.get("code") == CONTINUES)
    return next(found, None)
