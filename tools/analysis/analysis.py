"""Everything that is known of a run in the terms of the timing model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rack.boards.config import RackConfig
from rack.boards.config.timing import rack_timing
from rack.levels.timing.rack import LevelTiming
from rack.tools.analysis.breaches import Breach, breaches
from rack.tools.analysis.comparison import Pair, compare
from rack.tools.analysis.cycles import Cycles, cycles_of
from rack.tools.analysis.measured_budgets import WORST, budgets_of
from rack.tools.analysis.model import Model
from rack.tools.answer import Failure
from rack.tools.recording import Recording

MOSTLY = 99.0


@dataclass(frozen=True)
class Analysis:
    """A run against the timing model; `predicted` and `measured` are by board, `pairs` and `breaches` of everything.

    A level of whose budget the config says nothing is missing in `predicted`, one that never ran in `measured`.
    `mostly` are the pairs of the longest of `MOSTLY` in 100 cycles: a level that does not fit breaks its equations in
    most of its cycles, a machine that stalls now and then does not.
    """

    recording: Recording
    config: RackConfig
    model: Model
    percentile: float
    cycles: Mapping[str, Cycles]
    predicted: Mapping[str, LevelTiming]
    measured: Mapping[str, LevelTiming]
    pairs: tuple[Pair, ...]
    mostly: tuple[Pair, ...]
    breaches: tuple[Breach, ...]

    @classmethod
    def of(
        cls, recording: Recording, percentile: float = WORST, told: Callable[[float], None] = lambda part: None
    ) -> Analysis:
        """Analyze a recorded run; `told` hears which part is done. Raises `Failure` when its trace is empty or old."""
        config, layout = recording.rack_config, recording.layout
        found = cycles_of(recording)
        if not found:
            raise Failure(f"{recording.folder}: no cycle was traced; there is nothing to analyze", 2)
        told(0.4)
        model = Model.of(config, layout)
        pairs = tuple(compare(recording, config, found, percentile))
        told(0.7)
        return cls(
            recording=recording,
            config=config,
            model=model,
            percentile=percentile,
            cycles=found,
            predicted=rack_timing(config, layout).levels,
            measured=rack_timing(config, layout, budgets_of(found, percentile)).levels,
            pairs=pairs,
            mostly=tuple(compare(recording, config, found, min(percentile, MOSTLY))),
            breaches=tuple(breaches(found, model)),
        )

    @property
    def holds(self) -> bool:
        """Whether every equation held in the run."""
        return not any(pair.fails for pair in self.pairs)

    @property
    def judged_breaches(self) -> tuple[Breach, ...]:
        """The breaches that do not belong to the start-up of a process, the worst first."""
        return tuple(breach for breach in self.breaches if not breach.is_start_up)
