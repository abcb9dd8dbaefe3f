"""events.jsonl: what happened to a rack, one JSON object a line, the outcome last."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, TextIO

from boards.events import Event
from tools.display import Display


class EventLog:
    """Shows every event and keeps it; there is no file before the rack is launched."""

    def __init__(self, display: Display) -> None:
        self._display = display
        self._waiting: list[str] = []
        self._file: TextIO | None = None

    def add(self, event: Event) -> None:
        """Take an event."""
        self._display.tell(event)
        self._write(asdict(event))

    def open(self, path: Path) -> None:
        """Write to a file from now on, what came before as well."""
        # Line by line: the log of a run that was killed is whole up to then.
        self._file = path.open("w", buffering=1)
        self._file.writelines(self._waiting)

    def end(self, outcome: dict[str, Any]) -> None:
        """Write the outcome and close the file."""
        self._write({"time_ns": time.time_ns(), "kind": "outcome", **outcome})
        self.close()

    def close(self) -> None:
        """Close the file, with or without an outcome."""
        if self._file is not None:
            self._file.close()

    def _write(self, entry: dict[str, Any]) -> None:
        line = json.dumps(entry) + "\n"
        if self._file is None:
            self._waiting.append(line)
        else:
            self._file.write(line)
