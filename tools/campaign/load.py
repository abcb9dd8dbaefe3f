"""Load beside a rack: a busy process a core, under ordinary scheduling, and one that has the disks written.

As a program, `python -m rack.tools.campaign.load PARENT WHAT`: one of its processes, or stress-ng; it ends with its
parent.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rack.backplane.process import die_with_parent, name_process

DISKS = "disks"


@contextmanager
def load() -> Iterator[str]:
    """Keep every core that this process may use busy, and the disks; gives the load in words.

    `stress-ng` does it where it is installed.
    """
    cores = sorted(os.sched_getaffinity(0))
    stress = ["stress-ng", "--cpu", str(len(cores)), "--io", "1"]
    has_stress = shutil.which(stress[0]) is not None
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "rack.tools.campaign.load", str(os.getpid())]
    parts = [stress] if has_stress else [*([str(core)] for core in cores), [DISKS]]
    busy = [
        subprocess.Popen([*command, *part], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for part in parts
    ]
    try:
        yield " ".join(stress) if has_stress else f"{len(cores)} busy processes and one that writes"
    finally:
        for process in busy:
            # Not killed: stress-ng ends its own processes.
            process.terminate()
            process.wait()


def main() -> None:
    """Be a part of the load until the end of the parent."""
    parent, what = int(sys.argv[1]), sys.argv[2]
    die_with_parent(parent)
    if what == "stress-ng":
        os.execvp(what, sys.argv[2:])
    name_process("campaign load")
    if what != DISKS:
        os.sched_setaffinity(0, {int(what)})
    while True:
        if what == DISKS:
            os.sync()


if __name__ == "__main__":
    main()
