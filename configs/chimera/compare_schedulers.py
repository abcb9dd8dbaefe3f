"""Compare three schedulers under the overload of overload.toml: missed cycles of each board.

python compare_schedulers.py [KEY=VALUE ...]
"""

from __future__ import annotations

import sys
from pathlib import Path

from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config import load

CONFIG = Path(__file__).with_name("overload.toml")
SCHEDULERS = ("fixed-priority", "earliest-deadline-first", "maximum-urgency-first")
SECONDS = 2.0


def count_missed(scheduler: str, settings: list[str]) -> dict[str, tuple[int, int]]:
    """Run the overload in lockstep, and count the cycles of each board.

    Args:
        scheduler: The scheduler of all boards.
        settings: Further settings of the rack, KEY=VALUE.

    Returns:
        Cycles that were late or skipped, and cycles that were due, by board.
    """
    chosen = ["clock.mode=lockstep", f"clock.scheduler={scheduler}"]
    with Rack(load(CONFIG, [*chosen, *settings])) as rack:
        rack.run(SECONDS)
        segment = rack.segment
        end = segment.words[System.TICK] + 1
        counts = {task.board: segment.count_cycles(task, end) for task in segment.layout.tasks}
    return {board: (count.missed + count.skipped, count.due) for board, count in counts.items()}


def main(settings: list[str]) -> None:
    """Print a row for each board: whether it is critical, and its missed cycles by scheduler."""
    found = [count_missed(scheduler, settings) for scheduler in SCHEDULERS]
    print(f"{'board':11}{'critical':9}{'cycles':>6}", *(f"{name:>24}" for name in SCHEDULERS))
    for name, board in load(CONFIG, settings).board.items():
        missed = (f"{counts[name][0]:24}" for counts in found)
        print(f"{name:11}{'yes' * board.critical:9}{found[0][name][1]:6}", *missed)


if __name__ == "__main__":
    main(sys.argv[1:])
