"""Racks that exchange messages over a network, as one hierarchy with one system response.

A link between two racks counts as a level of the hierarchy (eqs 3.2 and 3.3). Its cycle is the
period of the exchange plus the delay and the losses that its budget permits. All times are in ns of
simulated time, because each rack has its own ticks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple

from rack.backplane.layout import Layout, TickGrid
from rack.boards.timing.chains import format_names
from rack.boards.timing.rack import RackTiming, compute_grid_wait
from rack.boards.timing.system_response import find_mailbox_row


class Station(NamedTuple):
    """A board of one of several racks."""

    rack: str
    board: str

    def __str__(self) -> str:
        return f"{self.rack}/{self.board}"


@dataclass(frozen=True)
class RackLink:
    """Path of the messages of one mailbox from a rack to the boards of another that read them.

    Attributes:
        source: Board that writes the mailbox.
        mailbox: The mailbox.
        rack: Rack that imports it.
        port: Name of the import.
        readers: Boards of the importing rack that read the messages.
        is_command: Whether the messages are commands, so that `source` is above the readers.
        exported: Times at which the messages are sent.
        imported: Times at which received messages are taken over.
        adapter_ns: Time from then until the readers can see them.
        delay_ns: Longest time on the network. None without a budget.
        max_lost: Number of messages in a row that may be lost.
    """

    source: Station
    mailbox: str
    rack: str
    port: str
    readers: tuple[str, ...]
    is_command: bool
    exported: TickGrid
    imported: TickGrid
    adapter_ns: int
    delay_ns: int | None
    max_lost: int

    @property
    def cycle_ns(self) -> int:
        """Cycle of the link as a level. Without a delay budget, the delay counts as 0."""
        return self.exported.every * (1 + self.max_lost) + (self.delay_ns or 0)

    def compute_taken_ns(self, written: TickGrid, is_lockstep: bool) -> int:
        """Return the longest time from the end of the writer's cycle until the message is taken.

        Args:
            written: Times at which the writer's messages become visible.
            is_lockstep: Whether the racks share their ticks. A message then passes the network in
                no simulated time, and none is lost. Otherwise the phases of their grids are
                unknown, and a message may just miss an exchange.
        """
        wait_ns = compute_grid_wait(written, self.exported)
        if is_lockstep:
            return wait_ns + compute_grid_wait(self.exported, self.imported)
        lost_ns = self.exported.every * self.max_lost
        return wait_ns + lost_ns + (self.delay_ns or 0) + self.imported.every

    def compute_shown_ns(self, read: TickGrid) -> int:
        """Return the longest time from taking a message over until a reader's release.

        Args:
            read: Times at which the reader reads.
        """
        every = self.imported.every
        shown = TickGrid(every, (self.imported.phase + self.adapter_ns) % every)
        return self.adapter_ns + compute_grid_wait(shown, read)


@dataclass(frozen=True)
class JoinedPath:
    """Predicted response along boards of several racks, of which the last rack measures it.

    Attributes:
        direction: "command", from the highest level down, or "status".
        stations: Boards in the direction of the information, as pairs of rack and board. The first
            is the earliest whose release the messages carry on to the last.
        port: Import of the last rack through which the information arrives.
        first_cycle_ms: Cycle of the first board.
        exchange_ms: Longest time between two messages of the import: its period, or the cycle of
            the writer.
        far_ms: Longest time from the first board's release until the release of the cycle that
            wrote the imported message.
        link_ms: Longest time from that release until the import takes the message over.
        response_ms: Longest response, including all waits.
        bound_eq_3_2_ms: Bound of eq. 3.2, where links count as levels.
        sum_eq_3_3_ms: Sum of eq. 3.3, likewise.
    """

    direction: Literal["command", "status"]
    stations: tuple[tuple[str, str], ...]
    port: str
    first_cycle_ms: float
    exchange_ms: float
    far_ms: float
    link_ms: float
    response_ms: float
    bound_eq_3_2_ms: float
    sum_eq_3_3_ms: float

    @property
    def boards(self) -> tuple[str, ...]:
        """Boards of the last rack."""
        return tuple(board for rack, board in self.stations if rack == self.stations[-1][0])


@dataclass(frozen=True)
class JoinedRacks:
    """Several racks and the links between them.

    Attributes:
        racks: Timing of each rack, by name.
        layouts: Layout of each rack, by name.
        links: Links between these racks.
    """

    racks: Mapping[str, RackTiming]
    layouts: Mapping[str, Layout]
    links: tuple[RackLink, ...]

    @cached_property
    def chains(self) -> tuple[tuple[Station, ...], ...]:
        """Every chain of boards, from a highest to a lowest level, that crosses a link."""
        lowest = [
            station
            for station in self._list_stations()
            if self._list_above(station) and not self._has_below(station)
        ]
        chains = (chain for station in lowest for chain in self._list_chains((station,)))
        return tuple(chain for chain in chains if len({station.rack for station in chain}) > 1)

    @property
    def unbudgeted_links(self) -> tuple[RackLink, ...]:
        """Links on these chains that have no delay budget."""
        ways = (way for chain in self.chains for way in (chain, chain[::-1]))
        links = dict.fromkeys(link for way in ways for link in self.list_chain_links(way) or ())
        return tuple(link for link in links if link.delay_ns is None)

    def list_paths(self, rack: str | None = None) -> list[JoinedPath]:
        """Return the predicted response of every chain, in each direction that information takes.

        Args:
            rack: Return only paths that end in this rack.
        """
        paths = [
            self._build_path(direction, stations)
            for chain in self.chains
            for direction, stations in (("command", chain), ("status", chain[::-1]))
            if rack in (None, stations[-1].rack) and self.list_chain_links(stations)
        ]
        return list(dict.fromkeys(paths))

    def _build_path(self, direction: Any, chain: tuple[Station, ...]) -> JoinedPath:
        """Return the predicted response along the part of a chain that messages allow to measure.

        Messages that depend on those of a further rack carry the release of its last board.
        """
        last = chain[-1].rack
        near = _find_beginning(chain)
        link = self.find_link(*chain[near - 1 : near + 1])
        assert link is not None, "the caller has checked it"
        writer = chain[near - 1]
        first = _find_beginning(chain[:near])
        boards = [station.board for station in chain[first:near]]
        row = find_mailbox_row(self.layouts[writer.rack], boards, [link.mailbox])
        start = near - len(row)
        if start == first and first > 0:
            start -= 1
        stations, far = chain[start:], chain[start:near]
        is_lockstep = self.racks[last].is_lockstep
        writer_ns = self.find_cycle_ns(writer)
        taken_ns = link.compute_taken_ns(self._find_releases(writer), is_lockstep)
        times_ns = (
            self.find_cycle_ns(stations[0]),
            max(link.exported.every, writer_ns),
            self.compute_response_ns(far) - writer_ns,
            writer_ns + taken_ns,
            self.compute_response_ns(stations),
            self.compute_bound_ns(stations),
            self.compute_sum_ns(stations),
        )
        return JoinedPath(direction, stations, link.port, *(ns * 1e-6 for ns in times_ns))

    def find_link(self, source: Station, reader: Station) -> RackLink | None:
        """Return the link that carries messages from one board to another, or None."""
        return next(
            (
                link
                for link in self.links
                if link.source == source
                and link.rack == reader.rack
                and reader.board in link.readers
            ),
            None,
        )

    def list_chain_links(self, stations: Sequence[Station]) -> list[RackLink] | None:
        """Return the links along boards in the direction of the information.

        Returns:
            The links, or None if information cannot pass between two of the racks.
        """
        pairs = [(one, other) for one, other in pairwise(stations) if one.rack != other.rack]
        links = [link for pair in pairs if (link := self.find_link(*pair)) is not None]
        return links if len(links) == len(pairs) else None

    def compute_response_ns(self, stations: Sequence[Station]) -> int:
        """Return the longest response along boards, in the direction of the information.

        As in `RackTiming.compute_response_ticks`, it lasts from the release of the first board to
        the end of the cycle in which the last board acts.
        """
        response_ns = sum(self.find_cycle_ns(station) for station in stations)
        for sender, receiver in pairwise(stations):
            here = self.racks[receiver.rack]
            board = here.boards[receiver.board]
            written = self._find_releases(sender)
            if sender.rack == receiver.rack:
                read = _to_ns(board.reads.get(sender.board, board.releases), here.clock_ns)
                response_ns += compute_grid_wait(written, read)
            elif (link := self.find_link(sender, receiver)) is not None:
                read = _to_ns(board.reads.get(LINK_BOARD, board.releases), here.clock_ns)
                response_ns += link.compute_taken_ns(written, here.is_lockstep)
                response_ns += link.compute_shown_ns(read)
        return response_ns

    def compute_bound_ns(self, stations: Sequence[Station]) -> int:
        """Return the bound of eq. 3.2, n R_max, where links count as levels."""
        cycles = self._list_cycles_ns(stations)
        return len(cycles) * max(cycles)

    def compute_sum_ns(self, stations: Sequence[Station]) -> int:
        """Return the sum of eq. 3.3, where links count as levels."""
        return sum(self._list_cycles_ns(stations))

    def find_cycle_ns(self, station: Station) -> int:
        """Return the cycle of a board."""
        rack = self.racks[station.rack]
        return rack.boards[station.board].every * rack.clock_ns

    def _list_cycles_ns(self, stations: Sequence[Station]) -> list[int]:
        """Return the cycles of all levels along a chain, links included."""
        links = self.list_chain_links(stations) or []
        return [*map(self.find_cycle_ns, stations), *(link.cycle_ns for link in links)]

    def _find_releases(self, station: Station) -> TickGrid:
        """Return the times at which the cycles of a board begin."""
        rack = self.racks[station.rack]
        return _to_ns(rack.boards[station.board].releases, rack.clock_ns)

    def _list_stations(self) -> Iterator[Station]:
        """Yield all boards of all racks."""
        for name, rack in self.racks.items():
            yield from (Station(name, board) for board in rack.boards)

    def _list_above(self, station: Station) -> list[Station]:
        """Return the boards directly above a board, in its rack and in others."""
        above = self.racks[station.rack].boards[station.board].above
        remote = (
            link.source
            for link in self.links
            if link.is_command and link.rack == station.rack and station.board in link.readers
        )
        return [*(Station(station.rack, name) for name in above), *remote]

    def _has_below(self, station: Station) -> bool:
        """Return True if a board has another one below it, in its rack or in others."""
        is_source = any(link.is_command and link.source == station for link in self.links)
        return is_source or bool(self.racks[station.rack].boards[station.board].below)

    def _list_chains(self, lower_end: tuple[Station, ...]) -> Iterator[tuple[Station, ...]]:
        """Yield every chain from a highest level down to and including `lower_end`."""
        above = [station for station in self._list_above(lower_end[0]) if station not in lower_end]
        if not above:
            yield lower_end
        for station in above:
            yield from self._list_chains((station, *lower_end))


def format_joined_levels(chains: Sequence[Sequence[tuple[str, str]]]) -> tuple[str, ...]:
    """Return the boards of each level of parallel chains as text, each with its rack."""
    return tuple(
        f"{level[0][0]}/{format_names(tuple(dict.fromkeys(board for _, board in level)))}"
        for level in zip(*chains, strict=True)
    )


LINK_BOARD = "lan"
"""Board of the network adapter, which writes imported messages."""


def _find_beginning(stations: Sequence[Station]) -> int:
    """Return the index of the first of the stations at the end that are in the last one's rack."""
    last = stations[-1].rack
    return next(
        at + 1 for at in range(len(stations) - 2, -2, -1) if at < 0 or stations[at].rack != last
    )


def _to_ns(grid: TickGrid, clock_ns: int) -> TickGrid:
    """Convert a grid of ticks to one in ns."""
    return TickGrid(grid.every * clock_ns, grid.phase * clock_ns)
