"""Aligns the recordings of several racks on one time line, the simulated time of the first rack.

In real time each machine has its own CLOCK_MONOTONIC, and each rack its own grid on it. Racks that
work together over a network record the offset of the other rack's clock (`rack.levels.peer`). With
these offsets, times are converted to the first rack, through other racks if necessary. In lockstep
all racks share one simulated time, and no conversion is needed.

Recordings of different launches have no common time line, and are rejected. In real time, tick 0
differs between launches, so the offset that a rack recorded and the peer's own recording must agree
on the peer's simulated time. In lockstep, where every launch begins at 0, the messages that a rack
imported must equal the messages of the sender.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rack.levels.peer import DRIFT_PPM, PeerPresence, Presence, format_peer_port
from rack.tools.console.answer import Failure
from rack.tools.recording.divergence import list_divergent_messages
from rack.tools.recording.origin import Origin
from rack.tools.recording.recording import Recording

Ints = NDArray[np.int64]
TOLERANCE_NS = 1_000_000
"""Largest difference between two records of the same simulated time.

Rounding causes smaller differences; different launches differ by seconds.
"""


class RackGrid:
    """The clock grid of a recorded rack, which maps ticks to its machine's CLOCK_MONOTONIC.

    Attributes:
        recording: The recording.
        rack: Name under which the rack is shown.
        is_lockstep: True if the rack ran in lockstep.
        clock_ns: Simulated duration of a tick.
        period_ns: Real duration of a tick.
        launch: Time of the launch.
        epoch_ns: Time of tick 0 on CLOCK_MONOTONIC.
        ticks: First and last recorded tick.
    """

    def __init__(self, recording: Recording) -> None:
        config = recording.rack_config
        self.recording = recording
        self.rack = recording.layout.rack
        self.is_lockstep = config.is_lockstep
        self.clock_ns = recording.layout.clock_ns
        self.period_ns = config.tick_ns
        self.launch = recording.launch
        cycles = [rows for rows in recording.cycles.values() if len(rows)]
        if not cycles:
            raise Failure(f"{recording.folder}: no cycle of any task is recorded", 2)
        releases = np.concatenate(
            [rows["release_ns"] - rows["tick"] * self.period_ns for rows in cycles]
        )
        self.epoch_ns = int(np.median(releases))
        self.ticks = (
            min(int(rows["tick"].min()) for rows in cycles),
            max(int(rows["tick"].max()) for rows in cycles),
        )

    def convert_ticks(self, ticks: Ints, within_ns: Ints | int = 0) -> Ints:
        """Convert ticks to CLOCK_MONOTONIC time stamps.

        Args:
            ticks: The ticks, shape (n,).
            within_ns: Simulated time to add to each tick.
        """
        within: Ints = np.asarray(within_ns) * self.period_ns // self.clock_ns
        return self.epoch_ns + ticks * self.period_ns + within

    def convert_stamps(self, stamps_ns: Ints) -> Ints:
        """Convert CLOCK_MONOTONIC time stamps to simulated time."""
        whole, rest = np.divmod(stamps_ns - self.epoch_ns, self.period_ns)
        return np.asarray(whole * self.clock_ns + rest * self.clock_ns // self.period_ns)


@dataclass(frozen=True)
class TimeShift:
    """Offset between the CLOCK_MONOTONIC of two machines.

    Attributes:
        at_ns: Time stamps of the first machine at which the offset was measured, shape (n,).
        by_ns: Measured offset: time stamp of the first machine minus time stamp of the second,
            shape (n,).
        uncertainty_ns: Largest error of the offset.
    """

    at_ns: Ints
    by_ns: Ints
    uncertainty_ns: int

    def convert_stamps(self, stamps_ns: Ints) -> Ints:
        """Convert time stamps of the first machine to the clock of the second machine."""
        # Interpolate differences from the first value. A float cannot represent a whole time stamp
        # in ns exactly.
        first = self.by_ns[0]
        by_ns = np.interp(stamps_ns - self.at_ns[0], self.at_ns - self.at_ns[0], self.by_ns - first)
        return np.asarray(stamps_ns - first - np.rint(by_ns).astype(np.int64))


class TimeLineNote(NamedTuple):
    """A note to the user, which is shown at a tick of the time line."""

    tick: int
    text: str


@dataclass(frozen=True)
class RackAlignment:
    """Conversion of a recorded rack's times to the time line, the first rack's simulated time.

    Attributes:
        grid: Grid of the rack.
        reference_grid: Grid of the first rack.
        shift: Clock offset between the rack's machine and the first rack's machine. None if both
            racks have the same ticks, as in lockstep, and for the first rack itself.
        is_tick_aligned: True if two runs of the same rack are aligned tick by tick.
        marks: Notes to show to the user on the time line. Empty for the first rack.
    """

    grid: RackGrid
    reference_grid: RackGrid
    shift: TimeShift | None = None
    is_tick_aligned: bool = False
    marks: tuple[TimeLineNote, ...] = ()

    @property
    def uncertainty_ns(self) -> int:
        """Largest error of the rack's time stamps after conversion to the first rack's machine."""
        return 0 if self.shift is None else self.shift.uncertainty_ns

    @property
    def note(self) -> str:
        """Sentence with the time at which the rack begins on the time line, and its uncertainty."""
        text = f"rack '{self.grid.rack}' is on the time line of '{self.reference_grid.rack}'"
        if self.grid.is_lockstep:
            return f"{text}: both ran in lockstep, tick by tick"
        line = self.reference_grid
        begin = line.convert_stamps(self.convert_stamps(np.array([self.grid.epoch_ns])))[0] * 1e-9
        uncertain_ms = self.uncertainty_ns * line.clock_ns / line.period_ns * 1e-6
        return (
            f"{text}: it begins at {begin:+.6f} s; its times are uncertain by {uncertain_ms:.3f} ms"
        )

    def convert_stamps(self, stamps_ns: Ints) -> Ints:
        """Convert time stamps of the rack's machine to the clock of the first rack's machine."""
        return stamps_ns if self.shift is None else self.shift.convert_stamps(stamps_ns)

    def convert_ticks(self, ticks: Ints, within_ns: Ints | int) -> Ints:
        """Convert ticks of the rack to simulated time of the first rack.

        Args:
            ticks: The ticks, shape (n,).
            within_ns: Simulated time of the rack to add to each tick.
        """
        if self.shift is None:
            return ticks * self.grid.clock_ns + within_ns
        return self.reference_grid.convert_stamps(
            self.convert_stamps(self.grid.convert_ticks(ticks, within_ns))
        )

    def convert_to_wall_clock(self, stamps_ns: Ints) -> Ints:
        """Convert time stamps of the rack's machine to the wall clock of the first rack's machine.

        Without a shift they are converted to the wall clock of the rack's own machine.
        """
        launch = self.grid.launch if self.shift is None else self.reference_grid.launch
        return self.convert_stamps(stamps_ns) + launch.wall_offset_ns


def align_racks(recordings: Sequence[Recording]) -> list[RackAlignment]:
    """Align recorded racks on the time line of the first rack.

    Returns:
        Conversion of the times of each rack, in the order of `recordings`.

    Raises:
        Failure: The racks did not run together, or no recorded clock offsets connect them.
    """
    grids = [RackGrid(recording) for recording in recordings]
    for index, grid in enumerate(grids):
        _check_compatible(grid, grids[:index])
    line = grids[0]
    places = [RackAlignment(line, line)]
    for grid in grids[1:]:
        place = RackAlignment(grid, line, _find_shift(grid, line))
        places.append(replace(place, marks=(TimeLineNote(0, place.note),)))
    return places


def align_runs(recordings: Sequence[Recording]) -> list[RackAlignment]:
    """Align two runs of the same rack tick by tick, for example a branch and its origin.

    Each run is shown under the name of its folder, because the rack has the same name in both.

    Raises:
        Failure: The recordings are not two runs of the same rack, or one of them lacks rows.
    """
    folders = [recording.folder.resolve() for recording in recordings]
    if len(recordings) != 2 or folders[0] == folders[1]:
        raise Failure("--against needs two runs of the same rack, in different folders", 2)
    differences = list_divergent_messages(*recordings)
    grids = [RackGrid(recording) for recording in recordings]
    names = [folder.name for folder in folders]
    if names[0] == names[1]:
        names = [str(folder) for folder in folders]
    for grid, name in zip(grids, names, strict=True):
        grid.rack = name
    marks = []
    if (origin := Origin.read_from(recordings[1])) is not None:
        marks.append(TimeLineNote(origin.tick, f"{names[1]} branches off"))
    if differences:
        first = differences[0]
        marks.append(
            TimeLineNote(first.tick, f"{names[1]} differs from {names[0]}: {first.mailbox}")
        )
    marks = marks or [TimeLineNote(0, f"all that {names[0]} and {names[1]} both wrote is equal")]
    line = grids[0]
    return [
        RackAlignment(line, line, is_tick_aligned=True),
        RackAlignment(grids[1], line, is_tick_aligned=True, marks=tuple(marks)),
    ]


def _check_compatible(grid: RackGrid, others: Sequence[RackGrid]) -> None:
    """Raise `Failure` if a rack cannot share a time line with one of the others.

    Their names must differ, and either all racks or none must have run in lockstep.
    """
    for other in others:
        if other.rack == grid.rack:
            where = f"{other.recording.folder} and {grid.recording.folder}"
            raise Failure(
                f"{where}: both are of rack '{grid.rack}'; give one recording of each rack, or one"
                " with --against the other",
                2,
            )
        if other.is_lockstep != grid.is_lockstep:
            timed, stepped = (other, grid) if grid.is_lockstep else (grid, other)
            where = (
                f"{stepped.recording.folder} ran in lockstep, {timed.recording.folder} in real time"
            )
            raise Failure(f"{where}: they have no time in common", 2)


def _find_shift(grid: RackGrid, line: RackGrid) -> TimeShift | None:
    """Return the clock offset that converts times of `grid` to times of `line`.

    Returns:
        The offset with the smallest error, or None for racks in lockstep, which share their ticks.

    Raises:
        Failure: Neither rack communicated with the other.
    """
    shifts: list[TimeShift] = []
    for observer, peer in ((line, grid), (grid, line)):
        mailbox = _find_peer_mailbox(observer, peer)
        if mailbox is None:
            continue
        if not grid.is_lockstep:
            if (shift := _read_offset(observer, mailbox, peer)) is not None:
                if observer is not line:
                    shift = TimeShift(shift.at_ns - shift.by_ns, -shift.by_ns, shift.uncertainty_ns)
                shifts.append(shift)
        elif Presence.THERE in observer.recording.read_signal(mailbox, "presence"):
            return None
    if not shifts:
        raise Failure(
            f"{grid.recording.folder}: rack '{grid.rack}' and '{line.rack}' never met: no recording"
            " holds a comparison of their clocks; first give a rack that is a peer of all others",
            2,
        )
    return min(shifts, key=lambda shift: shift.uncertainty_ns)


def _find_peer_mailbox(observer: RackGrid, peer: RackGrid) -> str | None:
    """Return the mailbox in which `observer` recorded the presence of `peer`, or None."""
    names = (
        box.name
        for box in observer.recording.layout.mailboxes
        if box.message == PeerPresence.message_type.name
        and box.name.endswith(f".{format_peer_port(peer.rack)}")
    )
    return next((name for name in names if name in observer.recording.mailboxes), None)


def _read_offset(observer: RackGrid, mailbox: str, peer: RackGrid) -> TimeShift | None:
    """Return the offset of the peer's clock that `observer` measured and recorded.

    Returns:
        The offset, with the peer's machine as the first one. None if it was never measured.

    Raises:
        Failure: `observer` measured only the clocks of other launches of the peer.
    """
    read = observer.recording.read_signal
    uncertainty = read(mailbox, "uncertainty")
    is_measured = uncertainty >= 0.0
    if not is_measured.any():
        return None
    ticks = read(mailbox, "tick")[is_measured]
    by_ns = np.rint(read(mailbox, "offset")[is_measured] * 1e9).astype(np.int64)
    at_ns = observer.convert_ticks(ticks) + by_ns
    seen_ns = np.rint(ticks * observer.clock_ns + read(mailbox, "ahead")[is_measured] * 1e9)
    disagreement_ns = peer.convert_stamps(at_ns) - seen_ns
    # A measurement before the peer's tick 0 cannot be assigned to a launch.
    is_this = (np.abs(disagreement_ns) <= TOLERANCE_NS) & (seen_ns > 0)
    if not is_this.any():
        began_s = float(disagreement_ns[-1]) * 1e-9 * peer.period_ns / peer.clock_ns
        raise Failure(
            f"{observer.recording.folder} and {peer.recording.folder} are not of the same run:"
            f" '{observer.rack}' met a launch of '{peer.rack}' that began {abs(began_s):.3f} s"
            f" {'later' if began_s > 0 else 'earlier'}",
            2,
        )
    at_ns = at_ns[is_this]
    by_ns = by_ns[is_this]
    # The clocks may drift between two measurements, before the first and after the last.
    ends = peer.convert_ticks(np.array(peer.ticks))
    longest_gap_ns = int(np.diff(np.sort(np.concatenate((at_ns, ends)))).max())
    worst_ns = round(float(uncertainty[is_measured][is_this].max()) * 1e9)
    return TimeShift(at_ns, by_ns, worst_ns + longest_gap_ns * DRIFT_PPM // 1_000_000)
