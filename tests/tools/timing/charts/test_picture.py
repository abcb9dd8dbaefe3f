"""Charts as pictures, whose letters fit, and in letters, which name the tasks left out."""

from __future__ import annotations

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from rack.boards.config import load, resolve_layout
from rack.boards.timing.tasks import Unit
from rack.tools.timing.charts.letters import choose_column_ns, format_panel
from rack.tools.timing.charts.panel import NS_PER_MS, Panel
from rack.tools.timing.charts.picture import WIDTH_IN, draw_panel
from rack.tools.timing.charts.scheduled import Schedule


def build_panel(rack: str, start_ms: float, end_ms: float) -> Panel:
    config = load(rack)
    schedule = Schedule(config, resolve_layout(config))
    return schedule.build_panel(round(start_ms * NS_PER_MS), round(end_ms * NS_PER_MS))


@pytest.mark.slow
@pytest.mark.parametrize(("rack", "end_ms"), [("fig2", 2.0), ("nasrem", 50.0)])
def test_a_letter_is_no_wider_than_its_span(rack: str, end_ms: float) -> None:
    panel = build_panel(rack, 0.0, end_ms)
    figure = Figure(figsize=(WIDTH_IN, 5.0), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    draw_panel(axes, panel)
    # With the layout of the saved picture.
    canvas.draw()
    to_data = axes.transData.inverted()
    letters = [text for text in axes.texts if text.get_text() in {unit.value for unit in Unit}]
    assert letters
    for text in letters:
        extent: Bbox = text.get_window_extent()
        left, right = (to_data.transform((x, 0.0))[0] for x in (extent.x0, extent.x1))
        middle = (left + right) / 2
        own = [s for s in panel.chart.spans if s.unit.value == text.get_text()]
        around = [s for s in own if s.start_ns < middle < s.end_ns]
        assert any(s.start_ns <= left and right <= s.end_ns for s in around)


def test_the_numbers_of_frames_stand_above_their_columns() -> None:
    panel = build_panel("cyclic", 0.0, 150.0)
    column_ns = choose_column_ns(150 * NS_PER_MS)
    frames = next(line for line in format_panel(panel, column_ns) if line.startswith("frame"))
    margin = frames.index("|")
    for number in (0, 2, 36):
        assert frames[margin + 2 * number :].startswith(f"|{number}")
    within = build_panel("cyclic", 50.0, 150.0).frames
    assert list(within.items()) == [(n, 4 * n * NS_PER_MS) for n in range(13, 38)]


def test_a_chart_in_letters_names_tasks_that_are_too_short_for_its_columns() -> None:
    coarse = list(format_panel(build_panel("cell", 1000.0, 1200.0), 2 * NS_PER_MS))
    assert "too short for a column: clock, lan, task; show less time, or see the picture" in coarse
    fine = list(format_panel(build_panel("cell", 1000.0, 1008.0), NS_PER_MS // 10))
    assert not [line for line in fine if line.startswith("too short")]
