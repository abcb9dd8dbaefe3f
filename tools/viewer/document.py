"""The run's papers: its config as a document, its properties."""

from __future__ import annotations

import platform

import rerun as rr

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig
from rack.tools.viewer.stream import Stream

CONFIG = "config"


def write_document(stream: Stream, text: str, config: RackConfig, layout: Layout) -> None:
    """Log the resolved config, and what run this is."""
    stream.static((CONFIG,), rr.TextDocument(f"```toml\n{text}```", media_type="text/markdown"))
    values = rr.AnyValues(
        rack=layout.rack,
        mode=config.clock.mode,
        speed=config.clock.speed,
        clock_ms=layout.clock_ns * 1e-6,
        tasks=[task.name for task in layout.tasks],
        robot=str(config.robot.model.stem) if config.robot else "none",
        machine=platform.platform(),
    )
    stream.property("run", values)
