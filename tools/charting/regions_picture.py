"""Figure 5 of the paper as a picture, PNG and SVG. matplotlib is loaded for this module alone."""

from __future__ import annotations

from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from rack.boards.config import RackConfig
from rack.tools.charting.regions import LONGEST_S, REGIONS, SHORTEST_S, TICKS, duration, placed

BANDS = ("#DDDDDD", "#F4C7B5", "#BFE3D8", "#C9DDF0")
"""From the fastest region to the slowest (light tints of Paul Tol's colours)."""
EDGE = "#222222"
MARKERS = {"tight": ("s", EDGE), "loose": ("s", "white"), "none": ("x", EDGE)}
MEANINGS = {"tight": "planner on its executor's processor", "loose": "planner on its own", "none": "no planner"}


def save(config: RackConfig, stem: Path) -> list[Path]:
    """Draw the figure with the levels of a rack into `stem`.png and .svg; return their paths."""
    levels = placed(config)
    with rc_context({"svg.hashsalt": config.name, "font.size": 9}):
        figure = Figure(figsize=(9.0, 1.7 + 0.36 * len(levels)), layout="constrained")
        axes = figure.subplots()
        starts = [SHORTEST_S, *(region.to_s for region in REGIONS[:-1])]
        ends = [*(region.to_s for region in REGIONS[:-1]), LONGEST_S]
        for region, start, end, colour in zip(REGIONS, starts, ends, BANDS, strict=True):
            axes.axvspan(start, end, color=colour, linewidth=0)
            words = region.words.replace(" or ", "\nor ").replace(", ", ",\n").replace(" multi", "\nmulti")
            axes.text((start * end) ** 0.5, -1.2, words, ha="center", va="center", fontsize=8)
        for row, level in enumerate(levels):
            marker, face = MARKERS[level.coupling]
            (point,) = axes.plot([level.cycle_s], [row], marker, markersize=8, markeredgewidth=1.4, clip_on=False)
            point.set(markerfacecolor=face, markeredgecolor=EDGE)
            label = f"{level.level}, {duration(level.cycle_s)}"
            axes.annotate(label, (level.cycle_s, row), (9, 0), textcoords="offset points", va="center")
        for coupling in dict.fromkeys(level.coupling for level in levels):
            marker, face = MARKERS[coupling]
            axes.plot([], [], marker, markerfacecolor=face, markeredgecolor=EDGE, label=MEANINGS[coupling])
        axes.set_xscale("log")
        axes.set_xlim(SHORTEST_S, LONGEST_S)
        axes.set_ylim(len(levels) - 0.4, -2.0)
        axes.set_xticks(list(TICKS), list(TICKS.values()))
        axes.minorticks_off()
        axes.set_yticks([])
        axes.set_xlabel("cycle")
        axes.set_title(f"Figure 5: what the cycles of {config.name} ask for", fontsize=10, loc="left")
        figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
        paths = [stem.with_name(f"{stem.name}.{kind}") for kind in ("png", "svg")]
        figure.savefig(paths[0], dpi=150)
        figure.savefig(paths[1], metadata={"Date": None})
    return paths
