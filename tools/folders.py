"""Where runs are kept."""

from __future__ import annotations

import time
from pathlib import Path

from rack.tools.answer import Failure

RUNS = Path("runs")


def folder_of(wanted: Path | None, rack: str) -> Path:
    """Return the folder of a run that is about to start: `wanted`, or runs/<rack>-<time>; it is made later.

    Raises `Failure` when `wanted` holds files already.
    """
    if wanted is None:
        name = f"{rack}-{time.strftime('%Y%m%d-%H%M%S')}"
        taken = len(list(RUNS.glob(f"{name}*")))
        return RUNS / (f"{name}-{taken + 1}" if taken else name)
    if wanted.exists() and (not wanted.is_dir() or any(wanted.iterdir())):
        raise Failure(f"--out {wanted}: is there already, and not an empty folder", 2)
    return wanted
