"""Common part of the benches of `rack bench`.

The help of each bench states the question that it answers. A bench is a function
`measure_...(..., progress)` that returns its results as a `Comparison`. `measure_and_show` calls
the function, shows the progress on the terminal, and prints the results as text or as one JSON
document.

The speed of a machine drifts by a factor of two within a day, so absolute times mean little.
`call_interleaved` calls the contestants alternately, in an order that changes from round to round.
Each one is judged by the ratio of its median to the median of the baseline in the same case. A peer
that is not installed is reported as `Absent`, and the others are still measured.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib import import_module
from random import Random
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from rack.tools.console.answer import Failure, print_json
from rack.tools.console.tables import Blocks, Cell, TextTable, format_decimal, print_blocks

if TYPE_CHECKING:
    from rack.tools.console.progress import Progress

INSTALL_COMMAND = "pip install 'nasrem-rack[lab]'"
"""Command that installs the peers that are Python packages."""
TERMINATION_TIMEOUT_S = 1.2
"""Longest wait for a program to end after SIGTERM, s."""
STATISTICS = ("median", "p99", "best", "worst")
"""Statistics of a sample, in the unit of the sample."""
_Name = TypeVar("_Name")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Sample:
    """Raw measurements of one contestant in one case, such as "time-slice" at "200 B".

    Smaller values are better.
    """

    case: str
    who: str
    values: tuple[float, ...]
    unit: str

    def __post_init__(self) -> None:
        if not self.values:
            raise ValueError(f"{self.who}, {self.case}: no measurements")

    @cached_property
    def median(self) -> float:
        """Median of the values."""
        return float(np.median(self.values))

    @cached_property
    def p99(self) -> float:
        """99th percentile of the values."""
        return float(np.percentile(self.values, 99.0))

    @property
    def best(self) -> float:
        """Smallest value."""
        return min(self.values)

    @property
    def worst(self) -> float:
        """Largest value."""
        return max(self.values)

    @property
    def count(self) -> int:
        """Number of measurements."""
        return len(self.values)


@dataclass(frozen=True)
class Absent:
    """A contestant that is not available on this machine.

    Attributes:
        who: Name of the contestant.
        reason: Reason for its absence.
        install: Command that installs it. Empty if there is none.
    """

    who: str
    reason: str
    install: str = ""

    @property
    def message(self) -> str:
        """Name, reason and command for installation in one line."""
        hint = f"; to install: {self.install}" if self.install else ""
        return f"absent: {self.who}: {self.reason}{hint}"


def find_missing_package(who: str, module: str) -> tuple[Absent, ...]:
    """Return a contestant as `Absent` if its module cannot be imported, else an empty tuple."""
    try:
        import_module(module)
    except ImportError as error:
        return (Absent(who, str(error), INSTALL_COMMAND),)
    return ()


def run_program(
    label: str,
    argv: Sequence[str],
    timeout_s: float,
    environment: Mapping[str, str] | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end.

    If it takes too long or this process is interrupted, it is terminated, and killed if necessary.

    Args:
        label: Name of the program in error messages.
        argv: Program and arguments.
        timeout_s: Longest permitted time, s.
        environment: All of its environment variables. None to inherit them.

    Returns:
        Exit status and output.

    Raises:
        Failure: If the program takes longer than `timeout_s`.
    """
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        argv,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=pipe,
        stderr=pipe,
        text=True,
        errors="replace",
    )
    try:
        stdout, stderr = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        raise Failure(f"{label}: still running after {timeout_s:g} s") from None
    finally:
        if process.poll() is None:
            _end_program(process)
    return subprocess.CompletedProcess(argv, process.returncode, stdout, stderr)


def _end_program(process: subprocess.Popen[str]) -> None:
    """Terminate a program, and kill it if it does not react in time."""
    process.terminate()
    try:
        process.communicate(timeout=TERMINATION_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


@dataclass(frozen=True)
class Comparison:
    """All samples of a bench, with their baselines.

    Attributes:
        name: Name of the bench in the command, one word.
        title: Description of the measured quantity.
        samples: Samples of all cases and contestants.
        baselines: Dictionary from cases to the contestants with which the others are compared. A
            case without a baseline has no ratios.
        absent: Contestants that are not available.
        conclusion: Conclusion from the figures, in one line. Empty if there is none.
    """

    name: str
    title: str
    samples: tuple[Sample, ...]
    baselines: Mapping[str, str]
    absent: tuple[Absent, ...] = ()
    conclusion: str = ""

    def find_sample(self, case: str, who: str) -> Sample | None:
        """Return one sample, or None if the contestant was not measured in this case."""
        return self._samples.get((case, who))

    def compute_ratio(self, sample: Sample, figure: str = "median") -> float | None:
        """Return a statistic of a sample divided by the same statistic of its baseline.

        Args:
            sample: Sample to compare.
            figure: One of the statistics.

        Returns:
            The ratio. None without a baseline, or if the statistic of the baseline is 0.
        """
        baseline = self._samples.get((sample.case, self.baselines.get(sample.case, "")))
        if baseline is None or not getattr(baseline, figure):
            return None
        return float(getattr(sample, figure) / getattr(baseline, figure))

    @cached_property
    def _samples(self) -> dict[tuple[str, str], Sample]:
        """Dictionary from case and contestant to their sample."""
        return {(sample.case, sample.who): sample for sample in self.samples}

    def to_document(self) -> dict[str, Any]:
        """Convert the comparison to plain data, without the raw values."""
        return {
            "bench": self.name,
            "title": self.title,
            "baselines": dict(self.baselines),
            "samples": [self._format_figures(sample) for sample in self.samples],
            "absent": [asdict(absentee) for absentee in self.absent],
            "conclusion": self.conclusion,
        }

    def _format_figures(self, sample: Sample) -> dict[str, Any]:
        """Return the statistics of a sample and its ratios to the baseline."""
        names = ("case", "who", "unit", "count", *STATISTICS)
        ratios = {
            "ratio": self.compute_ratio(sample),
            "p99_ratio": self.compute_ratio(sample, "p99"),
        }
        return {name: getattr(sample, name) for name in names} | ratios

    def format_blocks(self) -> Blocks:
        """Yield the results for the terminal: a table, absent contestants and the conclusion."""
        yield self.title
        rows: list[dict[str, Cell]] = [
            {
                "case": sample.case,
                "who": sample.who,
                "count": sample.count,
                **{name: format_value(getattr(sample, name)) for name in STATISTICS},
                "unit": sample.unit,
                "ratio": format_decimal(self.compute_ratio(sample), 2),
                "p99 ratio": format_decimal(self.compute_ratio(sample, "p99"), 2),
            }
            for sample in self.samples
        ]
        yield TextTable(rows, ("count", "worst", "p99 ratio", "best"))
        yield from (absentee.message for absentee in self.absent)
        if self.conclusion:
            yield self.conclusion


Found = TypeVar("Found", bound=Comparison)


def measure_and_show(measure: Callable[[Progress], Found], as_json: bool) -> Found:
    """Run a bench with its progress on the terminal, print the result, and return it."""
    from rack.tools.console.progress import open_progress

    with open_progress(as_json) as progress:
        comparison = measure(progress)
    if as_json:
        print_json(comparison.to_document())
    else:
        print_blocks(comparison.format_blocks())
    return comparison


def format_value(value: float) -> str:
    """Format a value with three significant digits, never with an exponent."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def call_interleaved(
    contestants: Mapping[_Name, Callable[[], _Result]],
    rounds: int,
    progress: Progress | None = None,
    each_s: float = 0.0,
) -> dict[_Name, list[_Result]]:
    """Call every contestant once in each round.

    The order changes from round to round, but is the same in every run of the bench.

    Args:
        contestants: Dictionary from the name of each contestant to its function.
        rounds: Number of rounds.
        progress: Shows each call. None for no progress.
        each_s: Expected time of a call, s.

    Returns:
        Dictionary from the name of each contestant to its results, oldest first.
    """
    results: dict[_Name, list[_Result]] = {name: [] for name in contestants}
    random = Random(rounds)
    for round_number in range(1, rounds + 1):
        for name in random.sample([*contestants], len(contestants)):
            if progress is not None:
                words = name if isinstance(name, tuple) else (name,)
                progress.begin_run(
                    f"{', '.join(map(str, words))}: round {round_number} of {rounds}"
                )
            results[name].append(contestants[name]())
            if progress is not None:
                progress.end_run(each_s)
    return results
