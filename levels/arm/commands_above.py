"""Freshness of the commands of several boards that drive an arm, or a hand, together."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from rack.levels.level import LevelContext, Mismatches, Reading, Verdict
from rack.levels.operator import SampledCommand
from rack.levels.robot.limits import MotorPatience


def check_commanders(context: LevelContext, wanted: Mapping[str, Collection[str]]) -> Mismatches:
    """Report each joint that is not commanded by exactly one board above.

    Args:
        context: The level that reads the commands.
        wanted: Joints that each board commands.
    """
    for joint in context.robot.joints:
        boards = [board for board, joints in wanted.items() if joint in joints]
        if len(boards) != 1:
            why = f"joint '{joint}' must be commanded by one board; {describe_commanders(boards)}"
            yield "above", [*wanted], why


def describe_commanders(boards: Iterable[str]) -> str:
    """Return a text with the boards that command a joint or the gripper."""
    named = ", ".join(f"'{board}'" for board in boards)
    return f"it is commanded by {named or 'none'}"


class CommandsAbove:
    """Checks that every board above has sent a command and that no command is stale.

    A command is stale if its age exceeds one cycle of this level, plus `cycles` cycles of the board
    that sends it, plus the patience of the motors or valves that keep applying it.

    Attributes:
        oldest: Maximum age of a command in ticks, keyed by board.
    """

    def __init__(
        self, context: LevelContext, patience: MotorPatience, cycles: int, what: str, halted: str
    ) -> None:
        """Derive the maximum ages from the cycles of the boards.

        Args:
            context: The level that reads the commands.
            patience: Time for which motors, or valves, keep a command.
            cycles: Cycles that a board needs for a command.
            what: Name of the commands, for the reasons of `find_missing`.
            halted: State of the arm or hand while a command is missing, for the same reasons.
        """
        self._what = what
        self._halted = halted
        self.oldest = {
            board: context.every + cycles * pace.every + patience.ticks(pace.every, context.tick_s)
            for board, pace in context.above.items()
        }

    def find_missing(
        self, commands: Mapping[str, Reading[SampledCommand]], tick: int, since: int
    ) -> str:
        """Return why a command is missing or stale, or an empty string if all are fresh.

        Args:
            commands: Readings of the commands, keyed by board.
            tick: Present tick.
            since: Tick of the oldest status on which a command may be based.
        """
        all_recent = True
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
            all_recent = all_recent and sampled >= since
        return "" if all_recent else f"{self._halted} until the boards above have seen it"
