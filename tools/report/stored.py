"""Loads and prints the stored report of a run, or builds it again if it is out of date.

A stored report is up to date if it is newer than the recording and than this program.
"""

from __future__ import annotations

import json
import sys
from itertools import chain
from pathlib import Path

from rack.tools.console.answer import Document, Failure, print_json
from rack.tools.recording.checksums import Checksums, read_file
from rack.tools.recording.file_names import SPOOL

REPORT_FILES = ("report.json", "report.md")
RECORDED_FILES = ("config.toml", "cycles.parquet", "signals", "events.jsonl")
PROGRAM_FOLDER = Path(__file__).resolve().parents[2]
PROGRAM_PACKAGES = ("backplane", "levels", "boards", "tools")


def read_stored_report(folder: Path) -> Document | None:
    """Return the stored report of a run as data.

    Returns:
        The report, or None if it must be built again: it is missing, out of date or damaged, or it
        contains a comparison with another run.
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
    except (OSError, ValueError, Failure):
        return None
    if not isinstance(data, dict) or data.get("against") or data.get("folder") != str(folder):
        # The report contains a comparison with another run, or the folder of the run has moved.
        return None
    return data


def load_report(folder: Path) -> Document:
    """Return the report of a run as data.

    A stored report that is up to date is reused. Otherwise the report is built and stored.
    """
    report = read_stored_report(folder)
    if report is None:
        # Import this only if needed, because the import is slow.
        from rack.tools.report.report import write_report

        report, _ = write_report(folder)
    return report


def print_report(data: Document, as_json: bool, is_full: bool) -> None:
    """Print a report as JSON, as a summary or as the whole text.

    Args:
        data: The report as data.
        as_json: Whether to print `data` as one JSON document.
        is_full: Whether to print the whole text.
    """
    if as_json:
        print_json(data)
        return
    if data["summary"] and not (is_full or data["against"] or sys.stdout.isatty()):
        # Printing stored lines needs no import of slow libraries.
        print(*data["summary"], sep="\n")
        return
    from rack.tools.console.tables import create_console, print_blocks
    from rack.tools.report.report_markdown import format_report
    from rack.tools.report.summary import show_summary

    if is_full:
        print_blocks(format_report(data))
    else:
        show_summary(data, create_console())
