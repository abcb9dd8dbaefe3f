"""Recordings of made-up machines, whose clocks differ, and whose racks have compared them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.history import build_row_dtype
from rack.backplane.segment import Launch
from rack.backplane.trace import RECORD
from rack.boards.config import load, resolve_layout
from rack.levels.peer import DRIFT_PPM, Presence, format_peer_port
from rack.tools.recording.recording import Recording
from tests.boards.lan.racks import rack_text
from tests.tools.recordings import recorded as write_recording

S, MS, US = 1_000_000_000, 1_000_000, 1_000
CLOCK_NS = 2_500_000
TICKS = 2000
EVERY = 8
ERROR_NS = 200 * US


@dataclass(frozen=True)
class Machine:
    """A machine, and the rack on it: its CLOCK_MONOTONIC at true time 0, its drift, and when the
    rack's tick 0 was."""

    rack: str
    clock_ns: int
    drift_ppm: int = 0
    begins_ns: int = 0
    speed: int = 1
    mode: str = "realtime"

    def shows(self, true_ns: int) -> int:
        """Return its CLOCK_MONOTONIC at a true time."""
        return true_ns + self.clock_ns + true_ns * self.drift_ppm // 1_000_000

    @property
    def epoch_ns(self) -> int:
        """CLOCK_MONOTONIC of tick 0."""
        return self.shows(self.begins_ns)

    @property
    def period_ns(self) -> int:
        return CLOCK_NS // self.speed

    def true_ns(self, tick: int) -> int:
        """Return the true time of a tick."""
        return round(
            (self.epoch_ns + tick * self.period_ns - self.clock_ns) / (1 + self.drift_ppm * 1e-6)
        )

    def time_ns(self, true_ns: int) -> int:
        """Return the rack's simulated time at a true time."""
        return max(0, (self.shows(true_ns) - self.epoch_ns) * self.speed)


def recorded(machine: Machine, others: Sequence[Machine], folder: Path, seed: int = 1) -> Recording:
    """Write the recording of a rack that compared its clock with those of others, each time with an
    error.

    In lockstep it counts, and takes the count of the others, each 4 ticks late.
    """
    names = [other.rack for other in others]
    heard = names[0] if names and machine.mode == "lockstep" else ""
    path = folder / "rack.toml"
    folder.mkdir(parents=True)
    path.write_text(rack_text(machine.rack, "tcp/127.0.0.1:7447", (), heard, peers=names))
    config = load(str(path), [f"clock.mode={machine.mode}", f"clock.speed={machine.speed}"])
    layout = resolve_layout(config)
    trace = np.zeros(TICKS, RECORD)
    trace["tick"] = np.arange(TICKS)
    for name in ("release_ns", "start_ns", "read_ns", "process_ns", "end_ns"):
        trace[name] = machine.epoch_ns + trace["tick"] * machine.period_ns
    boxes = [layout.find_mailbox(f"lan.{format_peer_port(other.rack)}") for other in others]
    messages = {
        box.name: sightings(machine, other, box, seed)
        for box, other in zip(boxes, others, strict=True)
    }
    if machine.mode == "lockstep":
        late = {"lan.other": 4} if others else {}
        for name, ticks in {"pulse.status": 0, **late}.items():
            rows = np.zeros((TICKS - ticks) // 4, build_row_dtype(layout.find_mailbox(name)))
            rows["basis"] = np.arange(0, TICKS - ticks, 4)
            rows["tick"] = rows["basis"] + ticks
            rows["message"]["count"] = rows["basis"]
            messages[name] = rows
    launch = Launch(machine.epoch_ns + 7 * S, machine.epoch_ns - S)
    return write_recording(folder, config, {"pulse": trace}, messages=messages, launch=launch)


def sightings(machine: Machine, other: Machine, box: MailboxSpec, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    rows = np.zeros(TICKS // EVERY, build_row_dtype(box))
    rows["tick"] = rows["basis"] = np.arange(0, TICKS, EVERY)
    message = rows["message"]
    message["presence"] = Presence.THERE
    if machine.mode == "lockstep":
        return rows
    message["uncertainty"] = -1.0
    for row in range(3, len(rows)):
        true_ns = machine.true_ns(int(rows["tick"][row]))
        offset_ns = (
            other.shows(true_ns)
            - machine.shows(true_ns)
            + int(random.integers(-ERROR_NS, ERROR_NS))
        )
        message["offset"][row], message["uncertainty"][row] = offset_ns * 1e-9, ERROR_NS * 1e-9
        stamp_ns = machine.epoch_ns + int(rows["tick"][row]) * machine.period_ns + offset_ns
        theirs_ns = max(0, stamp_ns - other.epoch_ns) * other.speed
        message["ahead"][row] = (theirs_ns - int(rows["tick"][row]) * CLOCK_NS) * 1e-9
    return rows


A = Machine("a", 5000 * S, begins_ns=1 * S)
B = Machine("b", 777_000 * S + 123, drift_ppm=DRIFT_PPM // 2, begins_ns=2 * S + 345_678)
C = Machine("c", 12 * S, drift_ppm=-DRIFT_PPM // 2, begins_ns=500 * MS, speed=2)
