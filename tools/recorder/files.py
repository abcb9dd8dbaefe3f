"""The two parquet files of a run, from what a recorder takes or from what a recorder that is gone has left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from rack.backplane.layout import Layout
from rack.tools.recorder.cycles import CyclesFile
from rack.tools.recorder.signals import SignalsFile
from rack.tools.recorder.spool import NAME, Frame, read
from rack.tools.recorder.steal import Stolen

CYCLES, SIGNALS = "cycles.parquet", "signals.parquet"
MENDED = "-mended"


class RunFiles:
    """cycles.parquet and signals.parquet of a folder, being written.

    `lost` counts lost rows by ring, `taken` those and the ones written: a ring's records so far.
    """

    def __init__(self, folder: Path, layout: Layout, suffix: str = "") -> None:
        self.tasks = [task.name for task in layout.tasks]
        self.lost = dict.fromkeys([*self.tasks, *(mailbox.name for mailbox in layout.mailboxes)], 0)
        self.taken = dict(self.lost)
        self._cycles = CyclesFile(folder / f"{CYCLES}{suffix}")
        self._signals = SignalsFile(folder / f"{SIGNALS}{suffix}", layout)

    def add(self, frame: Frame) -> None:
        """Take rows of a ring."""
        name, rows, lost = frame
        if name in self.tasks:
            self._cycles.add(name, rows)
        else:
            self._signals.add(name, rows)
        self.lost[name] += lost
        self.taken[name] += lost + len(rows)

    def close(self, stolen: Sequence[Stolen] = ()) -> None:
        """Finish both; the trace keeps the time that was stolen from its cores."""
        tasks = set(self.tasks)
        self._cycles.close({name: count for name, count in self.lost.items() if name in tasks}, stolen)
        self._signals.close({name: count for name, count in self.lost.items() if name not in tasks})


def mend(folder: Path) -> bool:
    """Make both files from the spool of a recorder that was killed; False where there is none.

    Raises `Failure` when that recorder is still at work, or its spool cannot be read.
    """
    if not (folder / NAME).is_file():
        return False
    made: list[RunFiles] = []

    def begin(layout: Layout) -> Callable[[Frame], None]:
        made.append(RunFiles(folder, layout, MENDED))
        return made[0].add

    read(folder, begin)
    made[0].close()
    for name in (CYCLES, SIGNALS):
        (folder / f"{name}{MENDED}").replace(folder / name)
    (folder / NAME).unlink()
    return True
