"""Figure 5 of the paper, as text and picture.

It shows the kind of concurrency that suits the cycle of each level of a rack.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, NamedTuple

from rack.boards.config import RackConfig
from rack.tools.console.answer import Document
from rack.tools.console.pictures import list_picture_paths, open_figure
from rack.tools.timing.tables import merge_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Range of the axis.
SHORTEST_S = 3e-5
LONGEST_S = 1e3
TICKS = {
    1e-4: "0.1 ms",
    1e-3: "1 ms",
    1e-2: "10 ms",
    1e-1: "100 ms",
    1.0: "1 s",
    10.0: "10 s",
    60.0: "1 min",
}
"""Dictionary from cycle times, s, to labels of the axis."""
REGION_COLOURS = ("#DDDDDD", "#F4C7B5", "#BFE3D8", "#C9DDF0")
"""Colours from the fastest region to the slowest, light tints of Paul Tol's palette."""
EDGE_COLOUR = "#222222"
MARKERS = {"tight": ("s", EDGE_COLOUR), "loose": ("s", "white"), "none": ("x", EDGE_COLOUR)}
COUPLING_MEANINGS = {
    "tight": "planner on its executor's processor",
    "loose": "planner on a separate processor",
    "none": "no planner",
}


class Region(NamedTuple):
    """A region of the figure: a range of cycle times and its kind of implementation.

    Attributes:
        name: Short name.
        to_s: Longest cycle, s.
        words: Name in the figure.
        asks: Place that the figure assigns to a planner.
    """

    name: str
    to_s: float
    words: str
    asks: str


REGIONS = (
    Region(
        "fine-grained",
        1e-3,
        "fine-grained multiprocessing or dedicated hardware",
        "dedicated hardware",
    ),
    Region("asynchronous", 0.25, "asynchronous multiprocessing", "a separate processor"),
    Region("multitasking", 60.0, "multitasking", "a task on the executor's processor"),
    Region("distributed", float("inf"), "distributed processing, on a LAN", "a separate machine"),
)
"""Regions by cycle: "under 1 ms", "250 ms", "seconds", "minutes".

A bound belongs to the faster region, except 1 ms.
"""
COUPLING_REGIONS = {"tight": "multitasking", "loose": "asynchronous"}
"""Dictionary from couplings to the short names of the regions for which the figure gives them."""


@dataclass(frozen=True)
class PlacedLevel:
    """A level in the figure.

    Attributes:
        level: Name of the level.
        cycle_s: Cycle, s.
        region: Region of this cycle.
        coupling: Coupling of its planner.
        remark: Comparison of the coupling with the region.
    """

    level: str
    cycle_s: float
    region: str
    coupling: str
    remark: str


def place_levels(config: RackConfig) -> list[PlacedLevel]:
    """Return the levels of a rack with their regions, beginning with the fastest one."""
    tick_s = config.tick_ns * 1e-9
    cycles = {name: config.find_period(name) * tick_s for name in config.board}
    return [
        PlacedLevel(
            name,
            cycle_s,
            region.words,
            coupling,
            f"{region.words}: {_format_remark(region, coupling)}",
        )
        for name, cycle_s in sorted(cycles.items(), key=lambda level: level[1])
        for region, coupling in [(find_region(cycle_s), config.board[name].coupling)]
    ]


def merge_levels(levels: Sequence[PlacedLevel]) -> list[PlacedLevel]:
    """Merge levels that differ only in their names, such as boards of joints, into one line."""
    return [PlacedLevel(**row) for row in merge_rows(map(vars, levels), "level")]


def find_region(cycle_s: float) -> Region:
    """Return the region that contains a cycle time."""
    return next(
        r for r in REGIONS if cycle_s < r.to_s or (cycle_s == r.to_s and r is not REGIONS[0])
    )


def format_figure(config: RackConfig) -> Iterator[str]:
    """Yield the figure as text: a heading, and a line with the cycle and remark of every level."""
    yield f"figure 5: levels of {config.name} in the regions of implementation, by their cycles"
    yield ""
    yield from (
        f"{level.level}, {format_duration(level.cycle_s)}: {level.remark}"
        for level in merge_levels(place_levels(config))
    )


def build_document(config: RackConfig) -> Document:
    """Return the figure as plain data. `to_s` of the last region is None."""
    regions = [
        {"name": r.words, "to_s": None if r.to_s == float("inf") else r.to_s} for r in REGIONS
    ]
    return {
        "rack": config.name,
        "figure": 5,
        "regions": regions,
        "levels": [asdict(level) for level in place_levels(config)],
    }


def format_duration(cycle_s: float) -> str:
    """Format a cycle time with a suitable unit."""
    if cycle_s >= 60.0:
        return f"{cycle_s / 60.0:g} min"
    return f"{cycle_s:g} s" if cycle_s >= 1.0 else f"{cycle_s * 1e3:g} ms"


def save_picture(config: RackConfig, stem: Path) -> list[Path]:
    """Draw the figure with the levels of a rack into `stem`.png and .svg. Returns their paths."""
    levels = merge_levels(place_levels(config))
    paths = list_picture_paths(stem)
    with open_figure(paths, 9.0, 1.7 + 0.36 * len(levels)) as figure:
        axes = figure.subplots()
        _draw_regions(axes)
        _draw_levels(axes, levels)
        axes.set_ylim(len(levels) - 0.4, -2.0)
        axes.set_title(
            f"Figure 5: implementations for the levels of {config.name}", fontsize=10, loc="left"
        )
        figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return paths


def _draw_regions(axes: Axes) -> None:
    """Draw the regions and the axis of cycle times."""
    borders = pairwise([SHORTEST_S, *(region.to_s for region in REGIONS[:-1]), LONGEST_S])
    for region, (start, end), colour in zip(REGIONS, borders, REGION_COLOURS, strict=True):
        axes.axvspan(start, end, color=colour, linewidth=0)
        words = fill(region.words, 18)
        axes.text((start * end) ** 0.5, -1.2, words, ha="center", va="center", fontsize=8)
    axes.set_xscale("log")
    axes.set_xlim(SHORTEST_S, LONGEST_S)
    axes.set_xticks(list(TICKS), list(TICKS.values()))
    axes.minorticks_off()
    axes.set_yticks([])
    axes.set_xlabel("cycle")


def _draw_levels(axes: Axes, levels: Sequence[PlacedLevel]) -> None:
    """Draw a marker and a label for each level, and the entries of the legend."""
    meanings = dict(COUPLING_MEANINGS)
    for row, level in enumerate(levels):
        marker, face = MARKERS[level.coupling]
        axes.plot(
            [level.cycle_s],
            [row],
            marker,
            markersize=8,
            markeredgewidth=1.4,
            clip_on=False,
            markerfacecolor=face,
            markeredgecolor=EDGE_COLOUR,
            label=meanings.pop(level.coupling, None),
        )
        label = f"{level.level}, {format_duration(level.cycle_s)}"
        axes.annotate(label, (level.cycle_s, row), (9, 0), textcoords="offset points", va="center")


def _format_remark(region: Region, coupling: str) -> str:
    """Return a remark that says whether the figure gives this coupling for a region."""
    if coupling == "none":
        return "no planner to couple"
    actual = f"coupled {coupling}ly"
    if COUPLING_REGIONS[coupling] == region.name:
        return f"{actual}, as in the figure"
    asked = f"the figure gives the planner {region.asks}"
    if region.name == "asynchronous":
        return f"{asked}; here it is {actual}, which is enough while eqs 3.8 and 3.10 hold"
    if region.name == "multitasking":
        return f"{asked}; here it is {actual}, at the cost of another processor"
    return f"{asked}; here it is {actual}"
