"""A Gantt chart in letters, as in the paper's figures.

It has a row for each lane, and each column shows a unit function.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import count, groupby

from rack.boards.timing.schedule import Chart
from rack.tools.console.tables import format_ms
from rack.tools.timing.charts.panel import Panel
from rack.tools.timing.charts.patterns import IDLE, Lane

OTHER_BOARD = "."
"""Sign of a column in which another board has the core."""
MAX_COLUMNS = 76
"""Maximum number of columns of a chart."""
MIN_CYCLE_COLUMNS = 4
"""Minimum number of columns of a cycle for its start to be marked."""
LABEL_COLUMNS = 6
MAX_WRITTEN_CYCLES = 3
"""Maximum number of equal successive cycles that are written individually."""
MAX_LISTED = 4
"""Maximum number of patterns or late jobs in a list."""


def format_panel(panel: Panel, column_ns: int) -> Iterator[str]:
    """Yield the lines of a panel."""
    chart = panel.chart
    yield (
        f"{panel.kind}, {format_ms(chart.start_ns)} to {format_ms(chart.end_ns)} ms, a column is"
        f" {format_ms(column_ns)} ms"
    )
    margin = max(len(lane.title) for lane in panel.lanes) + 2
    if panel.frames:
        starts = [
            ((start - chart.start_ns) // column_ns, f"|{number}")
            for number, start in choose_frame_labels(panel, column_ns)
        ]
        yield f"{'frame':{margin}}{format_label_row(starts)}"
    unseen = []
    for lane in panel.lanes:
        row = _format_lane(chart, lane, column_ns)
        yield f"{lane.title:{margin}}{row}"
        if not row.strip(IDLE + OTHER_BOARD) and any(
            span.task in lane.tasks for span in chart.spans
        ):
            unseen.append(lane.name)
        marks = _format_marks(panel, lane, column_ns)
        if marks:
            yield " " * margin + marks
    times = [
        ((time - chart.start_ns) // column_ns, format_ms(time))
        for time in choose_label_times(panel, column_ns)
    ]
    yield f"{' ' * margin}{format_label_row(times)} ms"
    if unseen:
        yield f"too short for a column: {', '.join(unseen)}; show less time, or see the picture"
    yield from _format_patterns(panel)
    yield from _format_late_jobs(panel)


def choose_column_ns(window_ns: int, shortest_ns: int = 0) -> int:
    """Return the width of a column, in ns, which is 1, 2 or 5 times a power of ten.

    Args:
        window_ns: Length of the window, ns. A column is wide enough for the window to fit into
            `MAX_COLUMNS`.
        shortest_ns: Upper limit of the width, ns, unless the window requires a wider column. 0 for
            the narrowest column with which the window fits.
    """
    steps: list[int] = [digit * 10**power for power in range(3, 12) for digit in (1, 2, 5)]
    fits = next((step for step in steps if window_ns <= MAX_COLUMNS * step), steps[-1])
    fine = max((step for step in steps if step <= shortest_ns), default=fits)
    return max(fits, fine)


def _format_lane(chart: Chart, lane: Lane, column_ns: int) -> str:
    """Return a letter for each column of a lane: the unit function that took most of it."""
    columns = -(-(chart.end_ns - chart.start_ns) // column_ns)
    shares: list[Counter[str]] = [Counter() for _ in range(columns)]
    for span in (span for span in chart.spans if span.core == lane.core):
        letter = span.unit.value if span.task in lane.tasks else OTHER_BOARD
        start, end = span.start_ns - chart.start_ns, span.end_ns - chart.start_ns
        for column in range(start // column_ns, -(-end // column_ns)):
            column_start = column * column_ns
            shares[column][letter] += min(end, column_start + column_ns) - max(start, column_start)
    for share in shares:
        # Idle time is added last, so that another letter with the same share is preferred.
        share[IDLE] = column_ns - share.total()
    return "".join(max(share, key=share.__getitem__) for share in shares)


def _format_marks(panel: Panel, lane: Lane, column_ns: int) -> str:
    """Return a row with "|" at starts of cycles and "!" at missed deadlines.

    The row is empty if there are none.
    """
    chart = panel.chart
    row = [" "] * (-(-(chart.end_ns - chart.start_ns) // column_ns) + 1)
    if lane.cycle_ns >= MIN_CYCLE_COLUMNS * column_ns:
        for start in lane.list_cycle_starts(chart.start_ns, chart.end_ns + 1):
            row[(start - chart.start_ns) // column_ns] = "|"
    for job in panel.list_late_jobs(lane):
        if job.deadline_ns >= chart.start_ns:
            row[(job.deadline_ns - chart.start_ns) // column_ns] = "!"
    return "".join(row).rstrip()


def format_label_row(labels: Iterable[tuple[int, str]]) -> str:
    """Return a row of labels. Each begins at its column or, if taken, after the previous label."""
    row = ""
    for column, label in labels:
        row = row.ljust(column) + label
    return row


def choose_frame_labels(
    panel: Panel, character_ns: int, prefix: str = "|"
) -> list[tuple[int, int]]:
    """Choose the minor frames to label, which are far enough apart for their labels.

    Args:
        panel: Panel with minor frames.
        character_ns: Time that a character takes on the axis, ns.
        prefix: Text of a label before the number.

    Returns:
        Number and start, in ns, of each of these frames.
    """
    frames = panel.frames
    widest_ns = max(len(f"{prefix}{number}") for number in frames) * character_ns
    steps = (digit * 10**power for power in count() for digit in (1, 2, 5))
    step = next(step for step in steps if step * panel.frame_ns >= widest_ns)
    return [(number, start) for number, start in frames.items() if number % step == 0]


def choose_label_times(panel: Panel, column_ns: int) -> range:
    """Return the times, in ns, at which the axis is labelled, far enough apart for the labels."""
    chart = panel.chart
    longest_ns = (chart.end_ns - chart.start_ns) // 2
    cycles = sorted(lane.cycle_ns for lane in panel.lanes)
    columns = 0
    widest = LABEL_COLUMNS
    while widest > columns:
        columns = widest
        least_ns = columns * column_ns
        # Prefer a cycle of a lane to a round number.
        step = next((cycle for cycle in cycles if least_ns <= cycle <= longest_ns), 0)
        step = step or choose_column_ns(least_ns * MAX_COLUMNS)
        times = range(-(-chart.start_ns // step) * step, chart.end_ns + 1, step)
        widest = max((len(format_ms(time)) + 2 for time in times), default=0)
    return times


def _format_patterns(panel: Panel) -> Iterator[str]:
    """Yield the patterns of every lane, beginning with the most frequent one."""
    for lane in panel.lanes:
        lane_patterns = panel.patterns[lane.name]
        cycles_name = "cycles without a plan" if lane.is_tight else "cycles"
        for counts, kind in ((lane_patterns.plans, "plans"), (lane_patterns.cycles, cycles_name)):
            if counts:
                yield from _format_counts(lane.name, counts, kind)


def _format_counts(name: str, counts: Counter[str], kind: str) -> Iterator[str]:
    """Yield the most frequent patterns with their counts.

    Args:
        name: Name of the lane.
        counts: Number of occurrences of each pattern.
        kind: Name of the counted units, "plans" or "cycles".
    """
    ranked = counts.most_common()
    (top, count), *others = ranked[:MAX_LISTED]
    margin = " " * len(name)
    yield f"{name}: {_shorten_pattern(top)}: {count} of {counts.total()} {kind}"
    yield from (f"{margin}  {_shorten_pattern(pattern)}: {number}" for pattern, number in others)
    if hidden := ranked[MAX_LISTED:]:
        yield f"{margin}  and {len(hidden)} more patterns: {sum(n for _, n in hidden)}"


def _shorten_pattern(pattern: str) -> str:
    """Shorten a pattern by writing equal successive cycles once, with their number."""
    runs = [(cycle, len(list(equal))) for cycle, equal in groupby(pattern.split(" | "))]
    return " | ".join(
        " | ".join([cycle] * n) if n <= MAX_WRITTEN_CYCLES else f"({cycle}) x {n}"
        for cycle, n in runs
    )


def _format_late_jobs(panel: Panel) -> Iterator[str]:
    """Yield the number of late jobs of each task, followed by its first late jobs in the window."""
    for lane in panel.lanes:
        for task in lane.tasks:
            count = panel.counts[task]
            if not count.late:
                continue
            kind = "plans" if task == lane.planner else "cycles"
            skipped = f", {count.skipped} of them skipped" if count.skipped else ""
            late = [job for job in panel.list_late_jobs(lane) if job.task == task]
            yield f"late: {task}: {count.late} of {count.jobs} {kind}{skipped}"
            for job in late[:MAX_LISTED]:
                release, due = format_ms(job.release_ns), format_ms(job.deadline_ns)
                done = "not done by then"
                if job.end_ns is not None:
                    late_ms = format_ms(job.end_ns - job.deadline_ns)
                    done = f"done at {format_ms(job.end_ns)} ms, {late_ms} ms late"
                yield f"  released at {release} ms, due at {due} ms: {done}"
