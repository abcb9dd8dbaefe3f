"""What a chart is of: a config, or a run with the config that it had."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rack.backplane.layout import Layout
from rack.boards.config import RackConfig, load, wire
from rack.tools.charting.measured import Run
from rack.tools.console.answer import Failure
from rack.tools.recording import Recording
from rack.tools.runs.folder import RUNS


@dataclass(frozen=True)
class Subject:
    """A config with its layout; `run` is the run of which it is. `folder` is where pictures of it go."""

    config: RackConfig
    layout: Layout
    run: Run | None
    folder: Path


def subject_of(text: str, settings: Sequence[str], out: Path | None) -> Subject:
    """Return what `text` names: a run's folder, else a config by name or path, with `settings`.

    Raises `Failure` and `ConfigError`.
    """
    path = Path(text)
    if path.is_dir() and ("/" in text or (path / "cycles.parquet").is_file()):
        if settings:
            raise Failure(f"--set {settings[0]}: {text} is a run, and its config is what it was", 2)
        run = Run(Recording(path))
        return Subject(run.config, run.recording.layout, run, out or path)
    if "/" in text and not path.exists():
        raise Failure(f"{text}: no such run's folder, and no such config", 2)
    config = load(text, settings)
    return Subject(config, wire(config), None, out or RUNS / f"{config.name}-gantt")
