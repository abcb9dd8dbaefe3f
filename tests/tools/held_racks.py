"""Racks that a command runs for as long as a test needs them."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rack.backplane.segment import Segment, list_racks
from rack.backplane.words import System
from tests.boards.table_racks import counting
from tests.processes import RACK, start_rack, wait_until
from tests.tools.command_line import BOUND_S, ROOT, rack
from tests.warm import Popen


@contextmanager
def held_rack(
    folder: Path, name: str, *options: str | Path
) -> Iterator[tuple[subprocess.Popen[bytes], Segment]]:
    """Run a counting rack that is held before tick 0, by default without a recording.

    Yields its launcher and its segment.
    """
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


@contextmanager
def running_rack(path: Path, name: str, *words: str) -> Iterator[str]:
    """Run the rack of a config that has no end, without a recording.

    Yields its name once it has begun to tick, and stops it at the end.
    """
    command = [*RACK, "run", path, "--no-record", f"--set=name={name}", *words]
    process = start_rack(command, name, path.with_name(f"{name}.log"))
    try:
        yield name
    finally:
        rack("stop", name)
        process.kill()
        process.wait()
