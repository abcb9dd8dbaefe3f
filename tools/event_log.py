"""events.jsonl: what happened to a rack, one JSON object a line, the outcome last."""

from __future__ import annotations

import json
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, TextIO

from rack.boards.events import Event
from rack.tools.display import Display


class EventLog:
    """Shows every event and keeps it; there is no file before the rack is launched.

    A file that cannot be written any more, on a disk that is full, is said once and is no reason to end a run.
    """

    def __init__(self, display: Display) -> None:
        self._display = display
        self._waiting: list[str] = []
        self._file: TextIO | None = None
        self._has_failed = False

    def add(self, event: Event) -> None:
        """Take an event."""
        self._display.tell(event)
        self._write(asdict(event))

    def open(self, path: Path) -> None:
        """Write to a file from now on, what came before as well."""
        # Line by line: the log of a run that was killed is whole up to then.
        self._file = path.open("w", buffering=1)
        waiting, self._waiting = self._waiting, []
        self._put("".join(waiting))

    def end(self, outcome: dict[str, Any]) -> None:
        """Write the outcome and close the file."""
        self._write({"time_ns": time.time_ns(), "kind": "outcome", **outcome})
        self.close()

    def close(self) -> None:
        """Close the file, with or without an outcome."""
        if self._file is not None:
            # What could not be written a moment ago is tried once more.
            with suppress(OSError):
                self._file.close()

    def _write(self, entry: dict[str, Any]) -> None:
        line = json.dumps(entry) + "\n"
        if self._file is None:
            self._waiting.append(line)
        else:
            self._put(line)

    def _put(self, text: str) -> None:
        try:
            if self._file is not None and not self._has_failed:
                self._file.write(text)
        except OSError as error:
            self._has_failed = True
            lost = f"events.jsonl ends here: {error.strerror}"
            self._display.tell(Event(time.time_ns(), -1, "recorder", "", lost))
