"""Which recorded runs take checkpoints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rack.boards.checkpoint.format import FOLDER
from rack.boards.config.schema import LAN, RackConfig
from rack.boards.wiring import Keeping


def are_wanted(config: RackConfig) -> bool:
    """Say whether a recorded run takes checkpoints, if its rack can."""
    return config.record.checkpoint_s > 0 and config.clock.mode == "lockstep"


def outside(config: RackConfig) -> str:
    """Return whose state is not the rack's, so that it has no checkpoints; empty: nobody's."""
    hosts = ", ".join(map(repr, config.host))
    found = [f"{hosts}: a host program's state"] if hosts else []
    found += [f"'{LAN}': what comes from the network"] if config.adapter.lan is not None else []
    return "; ".join(found)


def keeping_for(config: RackConfig, folder: Path, origin: Keeping | None) -> Keeping | None:
    """Return the checkpoints that a run recorded into `folder` takes, as `[record]` asks, next to
    the one that it continues from; without any, `origin`."""
    if not are_wanted(config) or outside(config):
        return origin
    every = max(1, round(config.record.checkpoint_s * 1e9 / config.clock_ns))
    return replace(origin or Keeping(), folder=(folder / FOLDER).resolve(), every=every)
