"""A counting rack, run by a command in lockstep and held before tick 0."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rack.backplane.segment import Segment, list_racks
from rack.backplane.words import System
from tests.boards.table_racks import counting
from tests.processes import RACK, wait_until
from tests.tools.command_line import BOUND_S, ROOT, rack
from tests.warm import Popen


@contextmanager
def held_rack(
    folder: Path, name: str, *options: str | Path
) -> Iterator[tuple[subprocess.Popen[bytes], Segment]]:
    """Run a rack, by default without a recording, and yield its launcher and its segment."""
    path = folder / "counting.toml"
    path.write_text(counting(folder))
    words = ("--lockstep", "--step", "--set", f"name={name}", *(options or ("--no-record",)))
    with Popen([*RACK, "run", path, *words], cwd=ROOT) as process:
        wait_until(lambda: name in list_racks(), BOUND_S)
        segment = Segment.attach(name)
        try:
            wait_until(lambda: segment.words[System.HELD], BOUND_S)
            yield process, segment
        finally:
            segment.close()
            process.kill()
    rack("clean")
