"""The recording as a stream: to a file always, to a viewer on this machine when one is wanted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rack.tools.viewer.timelines import SIM_TIME, TICK, WALL, Timelines

APPLICATION = "rack"
FLUSH_S = 0.5
"""Bound of one wait for the disk: the rings that are not drained meanwhile hold two seconds."""
SERVER_MEMORY = "200MB"
"""What the server keeps for a viewer that joins later."""


class Stream:
    """One recording being written. Its entities are named by parts, which may hold any character.

    Files of one `run` show as one recording. Raises `RuntimeError` from `flush` once the file cannot be written.
    """

    def __init__(
        self, name: str, run: str, file: Path, times: Timelines, blueprint: rrb.Blueprint, port: int | None
    ) -> None:
        self.times = times
        # Else a mistake is a warning on stderr and a hole in the recording.
        rr.set_strict_mode(True)
        self._recording = rr.RecordingStream(APPLICATION, recording_id=run)
        self._recording.set_log_time_enabled(False)
        self._recording.set_log_tick_enabled(False)
        sinks: list[rr.FileSink | rr.GrpcServerSink] = [rr.FileSink(str(file))]
        if port is not None:
            # A server, no client: a client without its viewer would hold up the file as well.
            sinks.append(rr.GrpcServerSink("127.0.0.1", port, server_memory_limit=SERVER_MEMORY))
        self._recording.set_sinks(*sinks, default_blueprint=blueprint)
        self._recording.send_recording_name(name)

    def static(self, entity: Sequence[str], *archetypes: rr.AsComponents) -> None:
        """Log what holds at all times."""
        self._recording.log(path(*entity), *archetypes, static=True)

    def columns(self, entity: Sequence[str], times: list[rr.TimeColumn], columns: rr.ComponentColumnList) -> None:
        """Send a block of rows."""
        self._recording.send_columns(path(*entity), times, columns)

    def scalars(self, entity: Sequence[str], times: list[rr.TimeColumn], values: np.ndarray) -> None:
        """Send a block of curves, shape (rows,) or (rows, curves)."""
        self.columns(entity, times, rr.Scalars.columns(scalars=values))

    def at(self, tick: int, stamp_ns: int, entity: Sequence[str], archetype: rr.AsComponents) -> None:
        """Log one rare thing that happened at a tick, at a time of CLOCK_MONOTONIC."""
        moment = self.times.moment(tick, stamp_ns)
        self._recording.set_time(SIM_TIME, duration=moment.sim_time)
        self._recording.set_time(TICK, sequence=tick)
        self._recording.set_time(WALL, timestamp=moment.wall)
        self._recording.log(path(*entity), archetype)

    def property(self, name: str, values: rr.AsComponents) -> None:
        """Log a property of the run."""
        self._recording.send_property(name, values)

    def flush(self) -> None:
        """Hand everything to the file. Raises `RuntimeError` when it cannot be written."""
        self._recording.flush(timeout_sec=FLUSH_S)

    def close(self) -> None:
        """Finish the file."""
        self._recording.disconnect()


def path(*parts: str) -> str:
    """Return the path of an entity from its parts."""
    return rr.new_entity_path(list(parts))
