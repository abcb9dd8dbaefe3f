"""Disk space of a recording."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from rack.tools.recording.file_names import CODE

RECORDED_ENDINGS = (".toml", ".jsonl", ".spool", ".parquet", ".rrd", "published.json", CODE)
"""Endings of recorded files. Reports and pictures, which do not count, have other endings."""


def measure_size(folder: Path) -> int:
    """Return the size of a run's recorded files in bytes, without reports and pictures."""
    size = 0
    for file in folder.rglob("*"):
        # A flight recorder may delete files while they are counted.
        with suppress(FileNotFoundError):
            if file.name.endswith(RECORDED_ENDINGS) and file.is_file():
                size += file.stat().st_size
    return size


def format_size(size: int, lasted_s: float) -> str:
    """Format the size of a recording and its data rate.

    Args:
        size: The size in bytes.
        lasted_s: Simulated time of the run. The rate is left out if it is 0.
    """
    rate = f", {size * 1e-6 / lasted_s:.2f} MB/s" if lasted_s else ""
    return f"{size * 1e-6:.1f} MB{rate}"


def format_recorded_line(folder: Path, lasted_s: float) -> str:
    """Return a line with the folder and the size of a recording."""
    return f"recorded into {folder}: {format_size(measure_size(folder), lasted_s)}"


def measure_sizes(folder: Path, lasted_s: float) -> dict[str, float | None]:
    """Return the size of a recording and its size per simulated second, in bytes.

    The size per second is None if `lasted_s` is 0.
    """
    size = measure_size(folder)
    return {"bytes": size, "bytes_per_s": round(size / lasted_s, 1) if lasted_s else None}
