"""A report as `rack report` and `rack run` print it: the one in the run's folder as long as that is
newer than the recording and this program.
"""

from __future__ import annotations

import json
from itertools import chain
from pathlib import Path

from rack.tools.console.answer import Document, Failure, print_json
from rack.tools.recording.checksums import Checksums, read_file
from rack.tools.recording.file_names import SPOOL

FILES = ("report.json", "report.md")
RECORDED = ("config.toml", "cycles.parquet", "signals", "events.jsonl")
PROGRAM = Path(__file__).resolve().parents[2]
FLOORS = ("backplane", "levels", "boards", "tools")


def stored_report(folder: Path) -> tuple[Document, str] | None:
    """Return the report in the folder of a run, as data and as text; None if it must be made
    anew, as of a recording that has been damaged since.
    """
    try:
        checksums = Checksums(folder)
        kept = (*FILES, *RECORDED)
        checksums.verify(*(name for name in checksums.stored if name.startswith(kept)))
        made_ns = min((folder / name).stat().st_mtime_ns for name in FILES)
        program = (path for floor in FLOORS for path in (PROGRAM / floor).rglob("*.py"))
        basis = chain((folder / name for name in RECORDED), program)
        if (folder / SPOOL).exists() or any(made_ns <= path.stat().st_mtime_ns for path in basis):
            return None
        data = json.loads(read_file(folder / FILES[0]))
        text = read_file(folder / FILES[1]).decode()
    except (OSError, ValueError, Failure):
        return None
    if not isinstance(data, dict) or data.get("against") or data.get("folder") != str(folder):
        # A comparison with another run is no report of this one, or the folder has been moved.
        return None
    return data, text


def newest_report(folder: Path) -> tuple[Document, str]:
    """Return the report of a run: the one in its folder if that is still right, otherwise a new
    one.
    """
    report = stored_report(folder)
    if report is None:
        # It takes long to import.
        from rack.tools.report.report import write_report

        report = write_report(folder)
    return report


def show_report(run: str | Path, as_json: bool) -> None:
    """Print the report of a run."""
    print_report(*newest_report(Path(run)), as_json)


def print_report(data: Document, text: str, as_json: bool) -> None:
    """Print a report: as one JSON document; on a terminal as much as fits; elsewhere, or of no
    recording, `text`.
    """
    if as_json:
        print_json(data)
        return
    from rack.tools.console.tables import print_blocks, terminal_width

    if terminal_width() is not None and data["folder"] is not None:
        from rack.tools.report.report_markdown import terminal_blocks

        print_blocks(terminal_blocks(data))
    else:
        print(text)
