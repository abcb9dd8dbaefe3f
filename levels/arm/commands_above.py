"""The commands of the boards above that drive an arm, or a hand, together: all of them must be
fresh.
"""

from __future__ import annotations

from collections.abc import Mapping

from rack.levels.level import LevelContext, Reading, Verdict
from rack.levels.operator import SampledCommand
from rack.levels.robot.limits import MotorPatience


class CommandsAbove:
    """Says whether the commands of the boards above are there and fresh; `oldest`: the ages
    permitted, ticks, by board.

    In messages they are called `what`, and the arm, or hand, is `halted` while one is missing. A
    command rests on a status of a cycle ago and takes `cycles` of its board; then the motors, or
    valves, keep it.
    """

    def __init__(
        self, context: LevelContext, patience: MotorPatience, cycles: int, what: str, halted: str
    ) -> None:
        self._what = what
        self._halted = halted
        self.oldest = {
            board: context.every + cycles * pace.every + patience.ticks(pace.every, context.tick_s)
            for board, pace in context.above.items()
        }

    def missing(
        self, commands: Mapping[str, Reading[SampledCommand]], tick: int, since: int
    ) -> str:
        """Return why commands are missing at `tick`; empty: all are fresh, and rest on a status of
        `since` or later.
        """
        all_know = True
        for board, oldest in self.oldest.items():
            value, verdict, is_lost, _ = commands[board]
            if is_lost:
                return f"board '{board}' is lost: {self._halted} until it is back"
            sampled = -1 if verdict is Verdict.NONE else value.sampled
            if sampled < 0:
                return f"no {self._what} from board '{board}' yet"
            if tick - sampled > oldest:
                return (
                    f"stale {self._what} from board '{board}': based on a status more than {oldest}"
                    " ticks old"
                )
            all_know = all_know and sampled >= since
        return "" if all_know else f"{self._halted} until the boards above have seen it"
