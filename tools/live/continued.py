"""Checkpoints as a user asks for them: `rack run --checkpoint S`, and `--from RUN@TIME`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rack.boards.checkpoint.format import FOLDER, checkpoints
from rack.boards.config.schema import RackConfig
from rack.boards.wiring import Keeping
from rack.tools.console.answer import Failure
from rack.tools.recording.parquet import CONFIG
from rack.tools.recording.recording import Recording


def run_of(origin: str) -> Path:
    """Return the config of the run in RUN@TIME. Raises `Failure`."""
    run, at, _ = origin.rpartition("@")
    path = Path(run) / CONFIG
    if not at:
        raise Failure(f"--from {origin}: permitted: RUN@TIME, as in runs/nasrem-1@12.5", 2)
    if not path.is_file():
        raise Failure(f"--from {origin}: {run or '.'} is not a run: it has no {CONFIG}", 2)
    return path


def keeping_for(
    config: RackConfig, folder: Path | None, every_s: float | None, origin: str | None
) -> Keeping | None:
    """Return the checkpoints that a run takes, and the one that it continues from. Raises
    `Failure`."""
    found = None if origin is None else _continued(config, origin)
    if every_s is None:
        return found
    if folder is None:
        raise Failure("--checkpoint and --no-record: checkpoints lie in the run's folder", 2)
    every = max(1, round(every_s * 1e9 / config.clock_ns))
    return replace(found or Keeping(), folder=(folder / FOLDER).resolve(), every=every)


def _continued(config: RackConfig, origin: str) -> Keeping:
    path = run_of(origin)
    run, _, text = origin.rpartition("@")
    kept = checkpoints(path.parent)
    if not kept:
        cure = f"from its beginning: rack run {path} --lockstep; --checkpoint S takes some"
        raise Failure(f"--from {origin}: {run} has no checkpoints; {cure}", 2)
    recording = Recording(path.parent)
    ended = recording.ended.get("outcome", {}).get("ticks", max(kept) + 1)
    tick = _tick(text, config)
    if not min(kept) <= tick < ended:
        first, last = (at * config.clock_ns * 1e-9 for at in (min(kept), ended - 1))
        why = f"permitted: {first:g} to {last:g} s, from its first checkpoint to its end"
        raise Failure(f"--from {origin}: {text}: {why}", 2)
    begins = max(at for at in kept if at <= tick)
    ran = recording.rack_config
    return Keeping(
        origin=kept[begins].resolve(),
        packages=config.python_path,
        faults=len(ran.fault),
        commands=len(ran.command),
        losses=tuple(
            (event["board"], event["tick"])
            for event in recording.events
            if event["kind"] == "died" and event["tick"] < begins
        ),
    )


def _tick(text: str, config: RackConfig) -> int:
    """Return the tick of a time; -1 for what is no time."""
    try:
        return round(float(text) * 1e9 / config.clock_ns)
    except (ValueError, OverflowError):
        return -1
