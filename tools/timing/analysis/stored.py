"""A report as `rack report` and `rack run` print it: the one in the run's folder as long as that is
newer than the recording and this program.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

from rack.tools.console.answer import Document, Failure, print_json
from rack.tools.recording.checksums import Checksums, read_file
from rack.tools.recording.recorder_process import SPOOL

FILES = ("report.json", "report.md")
RECORDED = ("config.toml", "cycles.parquet", "signals", "events.jsonl")
PROGRAM = Path(__file__).resolve().parents[3]


def stored_report(folder: Path) -> tuple[Document, str] | None:
    """Return the report in the folder of a run, as data and as text; None if it must be made
    anew, as of a recording that has been damaged since."""
    try:
        checksums = Checksums(folder)
        kept = (*FILES, *RECORDED)
        checksums.verify(*(name for name in checksums.stored if name.startswith(kept)))
        made_ns = min((folder / name).stat().st_mtime_ns for name in FILES)
        newest_ns = max((folder / name).stat().st_mtime_ns for name in RECORDED)
        if (folder / SPOOL).exists() or made_ns <= max(newest_ns, *_changed_ns()):
            return None
        data = json.loads(read_file(folder / FILES[0]))
        text = read_file(folder / FILES[1]).decode()
    except (OSError, ValueError, Failure):
        return None
    # A comparison with another run is no report of this one, and the folder may have been moved.
    is_own = (
        isinstance(data, dict) and not data.get("against") and data.get("folder") == str(folder)
    )
    return (data, text) if is_own else None


def _changed_ns() -> Iterator[int]:
    """Yield the times at which this program's files were changed."""
    for floor in ("backplane", "levels", "boards", "tools"):
        for path, _, names in os.walk(PROGRAM / floor):
            yield from (
                Path(path, name).stat().st_mtime_ns for name in names if name.endswith(".py")
            )


def newest_report(folder: Path) -> tuple[Document, str]:
    """Return the report of a run: the one in its folder if that is still right, otherwise a new
    one."""
    report = stored_report(folder)
    if report is None:
        from rack.tools.timing.analysis.report import write_report

        report = write_report(folder)
    return report


def show_report(run: str | Path, as_json: bool) -> None:
    """Print the report of a run."""
    print_report(*newest_report(Path(run)), as_json)


def print_report(data: Document, text: str, as_json: bool) -> None:
    """Print a report: as one JSON document; on a terminal as much as fits; elsewhere, or of no
    recording, `text`."""
    if as_json:
        print_json(data)
        return
    from rack.tools.console.tables import print_blocks, terminal_width

    if terminal_width() is not None and data["folder"] is not None:
        from rack.tools.timing.analysis.report_markdown import terminal_blocks

        print_blocks(terminal_blocks(data))
    else:
        print(text)
