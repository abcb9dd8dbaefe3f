"""CPU load beside a rack: one busy process a core, under ordinary scheduling.

As a program, `python -m tools.campaign.load CORE PARENT`: the busy process itself; it ends with its parent.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from boards.crate_line import PROJECT
from boards.processor import die_with_parent, name_process


@contextmanager
def cpu_load() -> Iterator[int]:
    """Keep every core that this process may use busy; gives the number of cores."""
    cores = sorted(os.sched_getaffinity(0))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(PROJECT), *sys.path])}
    command = [sys.executable, "-m", "tools.campaign.load"]
    busy = [subprocess.Popen([*command, str(core), str(os.getpid())], env=environment) for core in cores]
    try:
        yield len(cores)
    finally:
        for process in busy:
            process.kill()
            process.wait()


def main() -> None:
    """Keep a core busy until the end of the parent."""
    core, parent = int(sys.argv[1]), int(sys.argv[2])
    die_with_parent(parent)
    name_process("campaign load")
    os.sched_setaffinity(0, {core})
    while True:
        pass


if __name__ == "__main__":
    main()
