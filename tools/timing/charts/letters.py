"""A Gantt chart in letters, as in the paper's figures.

It has a row for each lane, and each column shows a unit function.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import count, groupby

from rack.boards.timing.schedule import Chart, Job
from rack.tools.console.tables import ms
from rack.tools.timing.charts.panel import Panel
from rack.tools.timing.charts.patterns import IDLE, Lane

OTHER = "."
"""Sign of a column in which another board has the core."""
COLUMNS = 100
"""Maximum number of columns of a chart."""
CYCLE_COLUMNS = 4
"""Minimum number of columns of a cycle for its start to be marked."""
LABEL_COLUMNS = 6
REPEATED = 3
"""Maximum number of equal successive cycles that are written individually."""
SHOWN = 4
"""Maximum number of patterns or late jobs in a list."""


def lines(panel: Panel, column_ns: int) -> Iterator[str]:
    """Yield the lines of a panel."""
    chart = panel.chart
    yield (
        f"{panel.kind}, {ms(chart.start_ns)} to {ms(chart.end_ns)} ms, a column is"
        f" {ms(column_ns)} ms"
    )
    margin = max(len(lane.title) for lane in panel.lanes) + 2
    if panel.frames:
        starts = [
            ((start - chart.start_ns) // column_ns, f"|{number}")
            for number, start in numbered_frames(panel, column_ns)
        ]
        yield f"{'frame':{margin}}{label_row(starts)}"
    unseen = []
    for lane in panel.lanes:
        row = _row(chart, lane, column_ns)
        yield f"{lane.title:{margin}}{row}"
        if not row.strip(IDLE + OTHER) and any(span.task in lane.tasks for span in chart.spans):
            unseen.append(lane.name)
        marks = _marks(panel, lane, column_ns)
        if marks:
            yield " " * margin + marks
    times = [
        ((time - chart.start_ns) // column_ns, ms(time)) for time in label_times(panel, column_ns)
    ]
    yield f"{' ' * margin}{label_row(times)} ms"
    if unseen:
        yield f"too short for a column: {', '.join(unseen)}; show less time, or see the picture"
    yield from _patterns(panel)
    yield from _late(panel)


def column_for(window_ns: int, shortest_ns: int | None) -> int:
    """Return the time of a column, ns: 1, 2 or 5 times a power of ten.

    If `shortest_ns` is given and long enough, a column is no longer than that.
    """
    steps: list[int] = [digit * 10**power for power in range(3, 12) for digit in (1, 2, 5)]
    fits = next((step for step in steps if window_ns <= COLUMNS * step), steps[-1])
    fine = max(
        (step for step in steps if shortest_ns is not None and step <= shortest_ns), default=fits
    )
    return max(fits, fine)


def _row(chart: Chart, lane: Lane, column_ns: int) -> str:
    """Return the letters of a lane, in each column the unit function that took most of it."""
    columns = -(-(chart.end_ns - chart.start_ns) // column_ns)
    shares: list[Counter[str]] = [Counter() for _ in range(columns)]
    for span in (span for span in chart.spans if span.core == lane.core):
        letter = span.unit.value if span.task in lane.tasks else OTHER
        start, end = span.start_ns - chart.start_ns, span.end_ns - chart.start_ns
        for column in range(start // column_ns, -(-end // column_ns)):
            column_start = column * column_ns
            shares[column][letter] += min(end, column_start + column_ns) - max(start, column_start)
    for share in shares:
        # Idle is added last and loses to a letter with the same share of the column.
        share[IDLE] = column_ns - share.total()
    return "".join(max(share, key=share.__getitem__) for share in shares)


def _marks(panel: Panel, lane: Lane, column_ns: int) -> str:
    """Return a row with "|" at starts of cycles and "!" at missed deadlines. Empty without any."""
    chart = panel.chart
    row = [" "] * (-(-(chart.end_ns - chart.start_ns) // column_ns) + 1)
    if lane.cycle_ns >= CYCLE_COLUMNS * column_ns:
        for start in range(lane.cycle_from(chart.start_ns), chart.end_ns + 1, lane.cycle_ns):
            row[(start - chart.start_ns) // column_ns] = "|"
    for job in panel.late(lane):
        if job.deadline_ns >= chart.start_ns:
            row[(job.deadline_ns - chart.start_ns) // column_ns] = "!"
    return "".join(row).rstrip()


def label_row(labels: Iterable[tuple[int, str]]) -> str:
    """Return a row of labels, each of which begins at its column or after the previous label."""
    row = ""
    for column, label in labels:
        row = row.ljust(column) + label
    return row


def numbered_frames(panel: Panel, character_ns: int, prefix: str = "|") -> list[tuple[int, int]]:
    """Return numbers and starts of the minor frames to be labelled, ns.

    Their distance is sufficient for the labels.

    Args:
        panel: Panel with minor frames.
        character_ns: Time that a character takes on the axis, ns.
        prefix: Text of a label before the number.
    """
    frames = panel.frames
    widest_ns = max(len(f"{prefix}{number}") for number in frames) * character_ns
    steps = (digit * 10**power for power in count() for digit in (1, 2, 5))
    step = next(step for step in steps if step * panel.frame_ns >= widest_ns)
    return [(number, start) for number, start in frames.items() if number % step == 0]


def label_times(panel: Panel, column_ns: int) -> range:
    """Return the times to write along the axis, ns, with sufficient distance for the numbers."""
    chart = panel.chart
    columns = 0
    widest = LABEL_COLUMNS
    while widest > columns:
        columns = widest
        step = step_for(panel, columns * column_ns)
        times = range(-(-chart.start_ns // step) * step, chart.end_ns + 1, step)
        widest = max((len(ms(time)) + 2 for time in times), default=0)
    return times


def step_for(panel: Panel, narrowest_ns: int) -> int:
    """Return the time between two labels of the axis, ns.

    It is the cycle of a lane, unless all cycles are too short or too long.
    """
    longest_ns = (panel.chart.end_ns - panel.chart.start_ns) // 2
    cycles = sorted(lane.cycle_ns for lane in panel.lanes)
    step = next((cycle for cycle in cycles if narrowest_ns <= cycle <= longest_ns), None)
    return step or column_for(narrowest_ns * COLUMNS, None)


def _patterns(panel: Panel) -> Iterator[str]:
    """Yield the patterns of every lane, beginning with the most frequent one."""
    for lane in panel.lanes:
        lane_patterns = panel.patterns.get(lane.name)
        if lane_patterns is None:
            continue
        cycles_name = "cycles without a plan" if lane.is_tight else "cycles"
        for counts, kind in ((lane_patterns.plans, "plans"), (lane_patterns.cycles, cycles_name)):
            if counts:
                yield from _counted(lane.name, counts, kind)


def _counted(name: str, counts: Counter[str], kind: str) -> Iterator[str]:
    """Yield the most frequent patterns with their counts.

    Args:
        name: Name of the lane.
        counts: Number of occurrences of each pattern.
        kind: Name of the counted units, "plans" or "cycles".
    """
    ranked = counts.most_common()
    (top, count), *others = ranked[:SHOWN]
    margin = " " * len(name)
    yield f"{name}: {_short(top)}: {count} of {counts.total()} {kind}"
    yield from (f"{margin}  {_short(pattern)}: {number}" for pattern, number in others)
    if hidden := ranked[SHOWN:]:
        yield f"{margin}  and {len(hidden)} more patterns: {sum(n for _, n in hidden)}"


def _short(pattern: str) -> str:
    """Shorten a pattern: long rows of equal cycles are written once."""
    runs = [(cycle, len(list(equal))) for cycle, equal in groupby(pattern.split(" | "))]
    return " | ".join(
        " | ".join([cycle] * n) if n <= REPEATED else f"({cycle}) x {n}" for cycle, n in runs
    )


def _late(panel: Panel) -> Iterator[str]:
    """Yield the number of late jobs of each task, with the first ones of the window."""
    for lane in panel.lanes:
        for task in lane.tasks:
            count = panel.counts.get(task)
            if count is None or not count.late:
                continue
            kind = "plans" if task == lane.planner else "cycles"
            skipped = f", {count.skipped} of them skipped" if count.skipped else ""
            late = [job for job in panel.late(lane) if job.task == task]
            yield f"late: {task}: {count.late} of {count.jobs} {kind}{skipped}"
            yield from (f"  {_story(job)}" for job in late[:SHOWN])


def _story(job: Job) -> str:
    """Describe the release, deadline and end of a late job."""
    due = f"released at {ms(job.release_ns)} ms, due at {ms(job.deadline_ns)} ms"
    if job.end_ns is None:
        return f"{due}: not done by then"
    return f"{due}: done at {ms(job.end_ns)} ms, {ms(job.end_ns - job.deadline_ns)} ms late"
