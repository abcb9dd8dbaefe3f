"""The folder of a run that is still being recorded, and its event log."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.events import Event
from rack.tools.recording.checksums import parse_checked_line
from rack.tools.recording.file_names import SPOOL


def find_run_folder(segment: Segment) -> Path | None:
    """Find the folder into which a rack is recorded.

    Returns None if it is not recorded, or if this cannot be seen from this PID namespace.
    """
    if not segment.launcher:
        return None
    with suppress(OSError):
        for file in Path(f"/proc/{segment.words[System.FOLLOWER_PID]}/fd").iterdir():
            # A descriptor may be closed while this loop runs.
            with suppress(OSError):
                if (path := file.readlink()).name == SPOOL:
                    return path.parent
    return None


class EventFile:
    """An events.jsonl, which may not exist yet."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read = 0

    def read_new_events(self) -> Iterator[Event]:
        """Yield the events that were added to the file since the last call."""
        if not self._path.is_file():
            return
        with self._path.open("rb") as file:
            file.seek(self._read)
            # A line that is still incomplete is read in the next call.
            lines = [line for line in file if line.endswith(b"\n")]
        self._read += sum(map(len, lines))
        for line in lines:
            event = parse_checked_line(line.decode())
            # The last line is the outcome, not an event. Leave out messages about waiting during
            # the launch, because the launch is over when somebody looks.
            if "tick" in event and not (event["kind"] == "waiting" and event["tick"] < 0):
                yield Event(**event)
