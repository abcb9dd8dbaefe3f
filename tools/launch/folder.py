"""The folder of a run, and its event log.

The log is events.jsonl: one JSON object a line, the outcome last.
"""

from __future__ import annotations

import json
import time
from contextlib import suppress
from dataclasses import asdict
from io import StringIO
from pathlib import Path
from typing import TextIO

from rack.boards.events import Event, get_event_order
from rack.tools.console.answer import Document, Failure
from rack.tools.monitor.display import Display
from rack.tools.recording.checksums import format_checked_line

RUNS = Path("runs")


def choose_run_folder(wanted: Path | None, rack: str) -> Path:
    """Choose the folder for a run that is about to start. It is created later.

    Args:
        wanted: The folder, or None for runs/<rack>-<time>.
        rack: Name of the rack.

    Raises:
        Failure: `wanted` is a file, or a folder that is not empty.
    """
    if wanted is None:
        name = f"{rack}-{time.strftime('%Y%m%d-%H%M%S')}"
        if taken := len(list(RUNS.glob(f"{name}*"))):
            name = f"{name}-{taken + 1}"
        return RUNS / name
    if wanted.exists() and (not wanted.is_dir() or any(wanted.iterdir())):
        raise Failure(f"--out {wanted}: exists already and is not an empty folder", 2)
    return wanted


class EventLog:
    """Shows every event and writes it to events.jsonl.

    The file is opened only after the rack has been launched. A failed write, as on a full disk, is
    reported once and does not end the run.

    Attributes:
        has_failed: True after an event could not be written.
    """

    def __init__(self, display: Display) -> None:
        self._display = display
        self._earlier = StringIO()
        self._file: TextIO = self._earlier
        self.has_failed = False

    def add_event(self, event: Event) -> None:
        """Show and write an event."""
        self._display.show_event(event)
        self._write_text(format_checked_line(asdict(event)))

    def open_file(self, path: Path) -> None:
        """Start writing to a file, beginning with all earlier events."""
        # Flush after each line, so that the log of a killed run is complete up to its end.
        self._file = path.open("w", buffering=1)
        self._write_text(self._earlier.getvalue())

    def write_outcome(self, outcome: Document) -> None:
        """Write the outcome, close the file, and sort its events.

        Before, they are in the order of their reports, which may differ from that of their ticks.
        """
        entry = {"time_ns": time.time_ns(), "kind": "outcome", **outcome}
        self._write_text(format_checked_line(entry))
        self.close()
        if self._file is not self._earlier and not self.has_failed:
            self._sort_lines(Path(self._file.name))

    def close(self) -> None:
        """Close the file, whether or not it has an outcome."""
        # After a failed write, closing would write again and fail again.
        with suppress(OSError):
            self._file.close()

    def _sort_lines(self, path: Path) -> None:
        """Sort the events in the file by tick. On a full disk the file stays unsorted."""
        lines = path.read_text().splitlines(keepends=True)
        ordered = sorted(lines, key=lambda line: get_event_order(json.loads(line)))
        if ordered == lines:
            return
        sorted_file = path.with_suffix(".part")
        with suppress(OSError):
            sorted_file.write_text("".join(ordered))
            sorted_file.replace(path)
        sorted_file.unlink(missing_ok=True)

    def _write_text(self, text: str) -> None:
        """Write a text. The first failed write is shown as an event; later texts are dropped."""
        try:
            if not self.has_failed:
                self._file.write(text)
        except OSError as error:
            self.has_failed = True
            lost = f"events.jsonl ends here: {error.strerror}"
            self._display.show_event(Event(time.time_ns(), -1, "recorder", "", lost))
