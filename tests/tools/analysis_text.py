"""An analysis as `rack analyze` prints it in a pipe."""

from __future__ import annotations

from rack.tools.console.tables import render_text
from rack.tools.report.analysis import Analysis
from rack.tools.report.tables import format_analysis


def text(analysis: Analysis, width: int | None = None) -> str:
    """Return all of it, as printed with --verbose."""
    return "\n".join(render_text(format_analysis(analysis, is_verbose=True), width))


def brief(analysis: Analysis) -> str:
    """Return what is printed without --verbose."""
    return "\n".join(render_text(format_analysis(analysis, is_verbose=False)))
