"""One run with commands at their ticks, recorded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.operating.config import CommandConfig
from rack.tools.recorder.recorder import LOCKSTEP_S, REALTIME_S, Recorder
from rack.tools.recording import Recording


def run(config: RackConfig, commands: Sequence[CommandConfig], folder: Path, seconds: float) -> Recording:
    """Run a rack with these commands for simulated `seconds`, or until its task ends; return its recording."""
    folder.mkdir(parents=True)
    wanted = config.model_copy(update={"command": (*config.command, *commands)})
    (folder / "config.toml").write_text(wanted.text())
    period_s = LOCKSTEP_S if config.clock.mode == "lockstep" else REALTIME_S
    with Rack(wanted) as rack, Recorder(rack.segment, folder) as recorder:
        rack.start(seconds)
        while rack.watch(period_s):
            recorder.drain()
        recorder.drain()
    return Recording(folder)
