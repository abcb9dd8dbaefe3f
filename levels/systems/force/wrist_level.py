"""The base of the levels that need what an arm's wrist senses."""

from __future__ import annotations

from collections.abc import Sequence

from rack.levels.level import Executor, LevelContext, Misfits


class WristLevel(Executor):
    """An executor for arms with a wrist sensor."""

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
        """Yield an arm without a wrist sensor, besides what any level of the kind finds."""
        yield from super().misfits(context, above, below)
        if context.robot.wrist is None:
            yield (
                "executor",
                cls.__name__,
                "it needs a wrist sensor: give the arm a table [robot.wrist]",
            )
