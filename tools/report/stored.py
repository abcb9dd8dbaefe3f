"""The report of `rack report` and `rack run`, which is reused while it is up to date.

A stored report is up to date if it is newer than the recording and this program.
"""

from __future__ import annotations

import json
from itertools import chain
from pathlib import Path

from rack.tools.console.answer import Document, Failure, print_json
from rack.tools.recording.checksums import Checksums, read_file
from rack.tools.recording.file_names import SPOOL

REPORT_FILES = ("report.json", "report.md")
RECORDED_FILES = ("config.toml", "cycles.parquet", "signals", "events.jsonl")
PROGRAM_FOLDER = Path(__file__).resolve().parents[2]
PROGRAM_PACKAGES = ("backplane", "levels", "boards", "tools")


def read_stored_report(folder: Path) -> tuple[Document, str] | None:
    """Return the stored report of a run as data and as text.

    None if the report must be made again, for example because the recording was damaged since.
    """
    try:
        checksums = Checksums(folder)
        files = (*REPORT_FILES, *RECORDED_FILES)
        checksums.verify(*(name for name in checksums.stored if name.startswith(files)))
        made_ns = min((folder / name).stat().st_mtime_ns for name in REPORT_FILES)
        program = (
            path for floor in PROGRAM_PACKAGES for path in (PROGRAM_FOLDER / floor).rglob("*.py")
        )
        basis = chain((folder / name for name in RECORDED_FILES), program)
        if (folder / SPOOL).exists() or any(made_ns <= path.stat().st_mtime_ns for path in basis):
            return None
        data = json.loads(read_file(folder / REPORT_FILES[0]))
        text = read_file(folder / REPORT_FILES[1]).decode()
    except (OSError, ValueError, Failure):
        return None
    if not isinstance(data, dict) or data.get("against") or data.get("folder") != str(folder):
        # The report contains a comparison with another run, or the folder has been moved.
        return None
    return data, text


def load_report(folder: Path) -> tuple[Document, str]:
    """Return the stored report of a run, or a new one if that is missing or out of date."""
    report = read_stored_report(folder)
    if report is None:
        # This import takes long.
        from rack.tools.report.report import write_report

        report = write_report(folder)
    return report


def show_report(run: str | Path, as_json: bool) -> None:
    """Print the report of a run."""
    print_report(*load_report(Path(run)), as_json)


def print_report(data: Document, text: str, as_json: bool) -> None:
    """Print a report.

    Args:
        data: The report as data.
        text: The report as text.
        as_json: Whether to print `data` as one JSON document. Otherwise a terminal gets the columns
            that fit, and any other output gets `text`, as does a run without a recording.
    """
    if as_json:
        print_json(data)
        return
    from rack.tools.console.tables import print_blocks, terminal_width

    if terminal_width() is not None and data["folder"] is not None:
        from rack.tools.report.report_markdown import format_for_terminal

        print_blocks(format_for_terminal(data))
    else:
        print(text)
