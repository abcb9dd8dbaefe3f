"""Racks that exchange messages over a network, as one hierarchy with one system response.

A link between two racks counts as a level of the hierarchy (eqs 3.2 and 3.3). Its cycle is the
period of the exchange plus the delay and the losses that its budget permits. All times are in ns of
simulated time, because each rack has its own ticks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple

from rack.backplane.layout import Layout, TickGrid
from rack.boards.timing.chains import format_names, list_chains
from rack.boards.timing.rack import RackTiming, compute_grid_wait
from rack.boards.timing.system_response import find_mailbox_rows


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
        imported: Times at which the importing adapter takes received messages over.
        adapter_ns: Time from taking a message over until the readers can see it.
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
        """Cycle in ns of the link, treated as a level. An unknown delay is taken as 0."""
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
    """Predicted response along boards of several racks. The last rack can measure it.

    Attributes:
        direction: "command", from the highest level down, or "status".
        stations: Boards in the direction of the information, as pairs of rack and board. The first
            is the farthest board whose release the messages state when they reach the last board.
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
        before: Path to the board that wrote the imported message, if it crosses a link.
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
    before: JoinedPath | None = field(default=None, kw_only=True)

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
    def crossings(self) -> dict[tuple[Station, Station], RackLink]:
        """Link between each pair of a board and another rack's board that reads its messages."""
        return {
            (link.source, Station(link.rack, reader)): link
            for link in reversed(self.links)
            for reader in link.readers
        }

    @cached_property
    def chains(self) -> tuple[tuple[Station, ...], ...]:
        """Every chain of boards, from a highest to a lowest level, that crosses a link."""
        above = {
            Station(name, board.name): [Station(name, upper) for upper in board.above]
            for name, rack in self.racks.items()
            for board in rack.boards.values()
        }
        for (source, reader), link in self.crossings.items():
            if link.is_command and reader in above:
                above[reader].append(source)
        return tuple(
            chain for chain in list_chains(above) if len({station.rack for station in chain}) > 1
        )

    @property
    def unbudgeted_links(self) -> tuple[RackLink, ...]:
        """Links on `chains` that have no delay budget."""
        ways = (way for chain in self.chains for way in (chain, chain[::-1]))
        links = dict.fromkeys(link for way in ways for link in self.list_chain_links(way) or ())
        return tuple(link for link in links if link.delay_ns is None)

    def list_paths(self, rack: str | None = None, *, is_whole: bool = False) -> list[JoinedPath]:
        """Return the predicted response of every chain, in each direction that information takes.

        Args:
            rack: Return only paths that end in this rack.
            is_whole: Whether recordings of all racks are at hand, instead of the last one alone.
        """
        paths = [
            self._build_path(direction, stations, is_whole)
            for chain in self.chains
            for direction, stations in (("command", chain), ("status", chain[::-1]))
            if rack in (None, stations[-1].rack) and self.list_chain_links(stations)
        ]
        return list(dict.fromkeys(paths))

    def _build_path(self, direction: Any, chain: tuple[Station, ...], is_whole: bool) -> JoinedPath:
        """Return the predicted response along the part of a chain whose response can be measured.

        It is measured from a release that the imported messages state. If they depend on messages
        of a third rack, they state the release of that rack's last board.

        Args:
            direction: "command" or "status".
            chain: Boards in the direction of the information.
            is_whole: Whether runs of the other racks are known, so that it continues there.
        """
        near = _find_beginning(chain)
        writer = chain[near - 1]
        link = self.crossings[writer, chain[near]]
        first = _find_beginning(chain[:near])
        boards = [station.board for station in chain[first:near]]
        row, *_ = find_mailbox_rows(self.layouts[writer.rack], boards, [link.mailbox])
        start = near - len(row)
        before = None
        if start == first and first > 0:
            start -= 1
            if is_whole:
                before = self._build_path(direction, chain[:near], is_whole)
                start = near - len(before.stations)
        stations, far = chain[start:], chain[start:near]
        written = self.find_grid(writer)
        # A board may write a mailbox less often than it cycles.
        box = self.layouts[writer.rack].find_mailbox(link.mailbox)
        clock_ns = self.racks[writer.rack].clock_ns
        published = TickGrid(box.every * clock_ns, box.phase * clock_ns)
        taken_ns = link.compute_taken_ns(published, self.racks[chain[-1].rack].is_lockstep)
        times_ns = (
            self.find_grid(stations[0]).every,
            max(link.exported.every, published.every),
            self.compute_response_ns(far) - written.every,
            written.every + taken_ns,
            self.compute_response_ns(stations),
            *self.compute_bounds_ns(stations),
        )
        times_ms = (ns * 1e-6 for ns in times_ns)
        return JoinedPath(direction, stations, link.port, *times_ms, before=before)

    def list_chain_links(self, stations: Sequence[Station]) -> list[RackLink] | None:
        """Return the links that information crosses on its way along `stations`.

        Returns:
            The links, or None if information cannot pass between two consecutive racks.
        """
        pairs = [pair for pair in pairwise(stations) if pair[0].rack != pair[1].rack]
        links = [self.crossings[pair] for pair in pairs if pair in self.crossings]
        return links if len(links) == len(pairs) else None

    def compute_response_ns(self, stations: Sequence[Station]) -> int:
        """Return the longest response, in ns, along boards in the direction of the information.

        As in `RackTiming.compute_response_ticks`, it lasts from the release of the first board to
        the end of the cycle in which the last board acts.
        """
        response_ns = sum(self.find_grid(station).every for station in stations)
        for sender, receiver in pairwise(stations):
            written = self.find_grid(sender)
            if (link := self.crossings.get((sender, receiver))) is None:
                response_ns += compute_grid_wait(written, self.find_grid(receiver, sender.board))
            else:
                response_ns += link.compute_taken_ns(written, self.racks[receiver.rack].is_lockstep)
                response_ns += link.compute_shown_ns(self.find_grid(receiver, LINK_BOARD))
        return response_ns

    def compute_bounds_ns(self, stations: Sequence[Station]) -> tuple[int, int]:
        """Return the bound n R_max of eq. 3.2 and the sum of eq. 3.3, with each link as a level."""
        links = self.list_chain_links(stations) or []
        cycles = [self.find_grid(station).every for station in stations]
        cycles += [link.cycle_ns for link in links]
        return len(cycles) * max(cycles), sum(cycles)

    def find_grid(self, station: Station, writer: str = "") -> TickGrid:
        """Return the times in ns at which a board begins its cycles, or reads from `writer`."""
        rack = self.racks[station.rack]
        board = rack.boards[station.board]
        grid = board.reads.get(writer, board.releases)
        return TickGrid(grid.every * rack.clock_ns, grid.phase * rack.clock_ns)


def format_joined_levels(chains: Sequence[Sequence[tuple[str, str]]]) -> tuple[str, ...]:
    """Return the boards of each level of parallel chains as text, each with its rack."""
    return tuple(
        f"{level[0][0]}/{format_names(tuple(dict.fromkeys(board for _, board in level)))}"
        for level in zip(*chains, strict=True)
    )


LINK_BOARD = "lan"
"""Board of the network adapter, which writes imported messages."""


def _find_beginning(stations: Sequence[Station]) -> int:
    """Return the lowest index from which all stations belong to the rack of the last one."""
    last = stations[-1].rack
    return next(
        at + 1 for at in range(len(stations) - 2, -2, -1) if at < 0 or stations[at].rack != last
    )
