"""Recordings of several racks on one time line: that of the first one.

In real time each machine has its own CLOCK_MONOTONIC, and each rack its own grid on it. Racks that
work together over a network record the offset of the other's clock (`rack.levels.peer`): from rack
to rack, these offsets lead to the first one's. In lockstep all racks have one simulated time, and
there is nothing to convert.

Recordings of different launches share no time line. In real time the mailbox of a peer says where
the peer's simulated time is, and the peer's recording says so too: launches have no tick 0 in
common. In lockstep, where every launch begins at 0, what a rack took from another must be what that
one wrote.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rack.levels.peer import DRIFT_PPM, PeerPresence, Presence, peer_port
from rack.tools.console.answer import Failure
from rack.tools.recording.divergence import unlike_messages
from rack.tools.recording.origin import continued_at
from rack.tools.recording.recording import Recording

Ints = NDArray[np.int64]
TOLERANCE_NS = 1_000_000
"""Difference between two accounts of one simulated time: rounding. Launches differ by seconds."""


class RackGrid:
    """The grid of a recorded rack: its simulated time on CLOCK_MONOTONIC of its machine."""

    def __init__(self, recording: Recording) -> None:
        config = recording.rack_config
        self.recording = recording
        self.rack = recording.layout.rack
        self.is_lockstep = config.clock.mode == "lockstep"
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
        """CLOCK_MONOTONIC of tick 0."""
        self.ticks = (
            min(int(rows["tick"].min()) for rows in cycles),
            max(int(rows["tick"].max()) for rows in cycles),
        )
        """The first and the last one recorded."""

    def stamp_ns(self, ticks: Ints, within_ns: Ints | int = 0) -> Ints:
        """Return the CLOCK_MONOTONIC of ticks, and `within_ns` of simulated time later."""
        within: Ints = np.asarray(within_ns) * self.period_ns // self.clock_ns
        return self.epoch_ns + ticks * self.period_ns + within

    def time_ns(self, stamps_ns: Ints) -> Ints:
        """Return the simulated times at those of CLOCK_MONOTONIC."""
        whole, rest = np.divmod(stamps_ns - self.epoch_ns, self.period_ns)
        return np.asarray(whole * self.clock_ns + rest * self.clock_ns // self.period_ns)


@dataclass(frozen=True)
class Shift:
    """How far CLOCK_MONOTONIC of one machine is ahead of another's: `by_ns`, at `at_ns` of the
    first; both (n,).
    """

    at_ns: Ints
    by_ns: Ints
    uncertainty_ns: int

    def to_other(self, stamps_ns: Ints) -> Ints:
        """Return stamps of the first machine as stamps of the other one."""
        # Relative to the first, so that the 53 bits of a float suffice.
        first = self.by_ns[0]
        by_ns = np.interp(stamps_ns - self.at_ns[0], self.at_ns - self.at_ns[0], self.by_ns - first)
        return np.asarray(stamps_ns - first - np.rint(by_ns).astype(np.int64))

    def reversed(self) -> Shift:
        """Return the shift of the other machine."""
        return Shift(self.at_ns - self.by_ns, -self.by_ns, self.uncertainty_ns)


class Mark(NamedTuple):
    """What a user should see on the time line, at a tick."""

    tick: int
    text: str


@dataclass(frozen=True)
class RackPlace:
    """A recorded rack on the time line: by what shifts its clock leads to the first rack's; without
    any it is there tick by tick, as the first one itself, racks in lockstep, and, `by_ticks`, two
    runs of one rack. `marks`: what a user should know of it, unless it is the first one.
    """

    own: RackGrid
    line: RackGrid
    shifts: tuple[Shift, ...] = ()
    by_ticks: bool = False
    marks: tuple[Mark, ...] = ()

    @property
    def uncertainty_ns(self) -> int:
        """Largest error of its stamps on the line's machine."""
        return sum(shift.uncertainty_ns for shift in self.shifts)

    @property
    def note(self) -> str:
        """What a user should know of it."""
        text = f"rack '{self.own.rack}' is on the time line of '{self.line.rack}'"
        if self.own.is_lockstep:
            return f"{text}: both ran in lockstep, tick by tick"
        begin = self.line.time_ns(self.stamps_ns(np.array([self.own.epoch_ns])))[0] * 1e-9
        uncertain_ms = self.uncertainty_ns * self.line.clock_ns / self.line.period_ns * 1e-6
        return (
            f"{text}: it begins at {begin:+.6f} s; its times are uncertain by {uncertain_ms:.3f} ms"
        )

    def stamps_ns(self, stamps_ns: Ints) -> Ints:
        """Return stamps of its machine as stamps of the line's."""
        for shift in self.shifts:
            stamps_ns = shift.to_other(stamps_ns)
        return stamps_ns

    def times_ns(self, ticks: Ints, within_ns: Ints | int) -> Ints:
        """Return simulated times on the line of its ticks, and `within_ns` of its own simulated
        time later.
        """
        if not self.shifts:
            return ticks * self.own.clock_ns + within_ns
        return self.line.time_ns(self.stamps_ns(self.own.stamp_ns(ticks, within_ns)))

    def wall_ns(self, stamps_ns: Ints) -> Ints:
        """Return stamps of its machine on the line's wall clock; without shifts on its own."""
        launch = self.line.launch if self.shifts else self.own.launch
        return self.stamps_ns(stamps_ns) + launch.wall_offset_ns


def on_one_time_line(recordings: Sequence[Recording]) -> list[RackPlace]:
    """Return where the racks of these recordings are on the time line of the first one.

    Raises `Failure` if they did not run together, or nothing leads from one to another.
    """
    grids = [RackGrid(recording) for recording in recordings]
    for at, grid in enumerate(grids):
        _check_company(grid, grids[:at])
    placed = {0: RackPlace(grids[0], grids[0])}
    while len(placed) < len(grids):
        near = [(a, b) for a in placed for b in range(len(grids)) if b not in placed]
        ways = ((a, b, way) for a, b in near if (way := _way(grids[b], grids[a])) is not None)
        if (found := next(ways, None)) is None:
            lone = next(grid for at, grid in enumerate(grids) if at not in placed)
            met = ", ".join(f"'{grids[at].rack}'" for at in placed)
            raise Failure(
                f"{lone.recording.folder}: rack '{lone.rack}' and {met} never met: no recording"
                " holds a comparison of their clocks; each rack needs one that has it among its"
                " peers",
                2,
            )
        a, b, shifts = found
        place = RackPlace(grids[b], grids[0], (*shifts, *placed[a].shifts))
        placed[b] = replace(place, marks=(Mark(0, place.note),))
    return [placed[at] for at in range(len(grids))]


def side_by_side(recordings: Sequence[Recording]) -> list[RackPlace]:
    """Return the places of two runs of one rack, tick by tick, each by the name of its folder; a
    branch and the run that it branches off, say.

    Raises `Failure` if they are not of one rack, or lack rows.
    """
    folders = [recording.folder.resolve() for recording in recordings]
    if len(recordings) != 2 or folders[0] == folders[1]:
        raise Failure("--against: permitted: two runs of one rack, a folder each", 2)
    unlike = unlike_messages(*recordings)
    other = recordings[1]
    grids = [RackGrid(recording) for recording in recordings]
    names = [folder.name for folder in folders]
    if names[0] == names[1]:
        names = [str(folder) for folder in folders]
    for grid, name in zip(grids, names, strict=True):
        grid.rack = name
    marks = []
    if (tick := continued_at(other)) is not None:
        marks.append(Mark(tick, f"{names[1]} branches off"))
    if unlike:
        first = unlike[0]
        marks.append(Mark(first.tick, f"{names[1]} differs from {names[0]}: {first.mailbox}"))
    marks = marks or [Mark(0, f"all that {names[0]} and {names[1]} both wrote is equal")]
    line = grids[0]
    return [
        RackPlace(line, line, by_ticks=True),
        RackPlace(grids[1], line, by_ticks=True, marks=tuple(marks)),
    ]


def _check_company(grid: RackGrid, others: Sequence[RackGrid]) -> None:
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


def _way(own: RackGrid, other: RackGrid) -> tuple[Shift, ...] | None:
    """Return the shift that leads from a rack's clock to another's, if either has compared them; in
    lockstep none.
    """
    if own.is_lockstep:
        met = [_has_met(one, two) for one, two in ((own, other), (other, own))]
        return () if any(met) else None
    seen = _sighting(other, own), _sighting(own, other)
    found = [shift for shift in (seen[0], seen[1] and seen[1].reversed()) if shift is not None]
    return (min(found, key=lambda shift: shift.uncertainty_ns),) if found else None


def _mailbox(of: RackGrid, peer: RackGrid) -> str | None:
    """Return the mailbox in which a rack keeps what it knows of another, if there is one."""
    boxes = of.recording.layout.mailboxes
    names = (
        box.name
        for box in boxes
        if box.message == PeerPresence.message_type.name
        and box.name.endswith(f".{peer_port(peer.rack)}")
    )
    return next((name for name in names if name in of.recording.mailboxes), None)


def _sighting(of: RackGrid, peer: RackGrid) -> Shift | None:
    """Return how far a peer's clock is ahead, as a rack has recorded it; None if it never measured
    that.

    Raises `Failure` if it has met other launches of the peer only.
    """
    if (mailbox := _mailbox(of, peer)) is None:
        return None
    read = of.recording.signal
    uncertainty = read(mailbox, "uncertainty")
    known = uncertainty >= 0.0
    if not known.any():
        return None
    ticks = read(mailbox, "tick")[known]
    by_ns = np.rint(read(mailbox, "offset")[known] * 1e9).astype(np.int64)
    at_ns = of.stamp_ns(ticks) + by_ns
    seen_ns = np.rint(ticks * of.clock_ns + read(mailbox, "ahead")[known] * 1e9)
    apart_ns = peer.time_ns(at_ns) - seen_ns
    # Of a peer that had not begun yet, nothing says which launch it was.
    is_this = (np.abs(apart_ns) <= TOLERANCE_NS) & (seen_ns > 0)
    if not is_this.any():
        began_s = float(apart_ns[-1]) * 1e-9 * peer.period_ns / peer.clock_ns
        raise Failure(
            f"{of.recording.folder} and {peer.recording.folder} are not of the same run: the rack"
            f" '{peer.rack}' that '{of.rack}' met began {abs(began_s):.3f} s"
            f" {'later' if began_s > 0 else 'earlier'}",
            2,
        )
    at_ns = at_ns[is_this]
    by_ns = by_ns[is_this]
    order = np.argsort(at_ns, kind="stable")
    at_ns = at_ns[order]
    by_ns = by_ns[order]
    # Between two comparisons, and before the first and after the last, the clocks may drift.
    ends = peer.stamp_ns(np.array(peer.ticks))
    alone_ns = int(np.diff(np.sort(np.concatenate((at_ns, ends)))).max())
    worst_ns = round(float(uncertainty[known][is_this].max()) * 1e9)
    return Shift(at_ns, by_ns, worst_ns + alone_ns * DRIFT_PPM // 1_000_000)


def _has_met(of: RackGrid, peer: RackGrid) -> bool:
    """Return whether a rack in lockstep worked with another. Raises `Failure` if that was not in
    this run.
    """
    mailbox = _mailbox(of, peer)
    if mailbox is None or not (of.recording.signal(mailbox, "presence") == Presence.THERE).any():
        return False
    lan = of.recording.rack_config.adapter.lan
    for port, entry in () if lan is None else lan.imports.items():
        if entry.rack == peer.rack:
            _check_import(of, f"{mailbox.partition('.')[0]}.{port}", peer, entry.mailbox)
    return True


def _check_import(of: RackGrid, taken: str, peer: RackGrid, written: str) -> None:
    """Check that what a rack took from another is what that one wrote."""
    if taken not in of.recording.mailboxes or written not in peer.recording.mailboxes:
        return
    took = of.recording.rows(taken)
    wrote = peer.recording.rows(written)
    at_ns = wrote["tick"] * peer.clock_ns
    content = [row.tobytes() for row in wrote["message"]]
    for row in took:
        # Its tick there is only known in ticks here, which may be longer.
        since_ns = int(row["basis"]) * of.clock_ns
        first, end = np.searchsorted(at_ns, (since_ns, since_ns + of.clock_ns))
        if first < end and row["message"].tobytes() not in content[first:end]:
            raise Failure(
                f"{of.recording.folder} and {peer.recording.folder} are not of the same run: what"
                f" '{of.rack}' took from '{peer.rack}' at {since_ns * 1e-9:.4f} s, in {taken}, is"
                f" not what that one wrote to {written}",
                2,
            )
