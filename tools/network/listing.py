"""Racks at hosts, as `rack list --lan` shows them: each asked for its state, all hosts at once."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain

from rack.backplane.checked import as_named
from rack.backplane.errors import SegmentError
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment, racks
from rack.backplane.words import Head, Run, System
from rack.boards.lan.endpoint import Endpoint
from rack.levels.peer import Presence, peer_port
from rack.tools.console.address import Asker, HostAddress, RackAddress
from rack.tools.console.answer import Failure
from rack.tools.network.questioner import Questioner
from rack.tools.network.remote import RemoteRack

AT_ONCE = 8
"""Hosts that are asked at the same time."""


@dataclass(frozen=True)
class FoundRack:
    """A rack at a host, or why there is none to show: then `rack` is empty.

    `age_s` is the time since its launch, by its own machine's clock; None where it does not say.
    `peers` are the racks that it works with, and where each is.
    """

    host: str
    rack: str
    state: str
    detail: str
    age_s: float | None = None
    peers: tuple[tuple[str, str], ...] = ()


def racks_at(hosts: Sequence[HostAddress], asker: Asker) -> list[FoundRack]:
    """Return the racks at these hosts, in their order."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        found = pool.map(lambda host: list(_at(host, asker)), hosts)
        return list(chain.from_iterable(found))


def known_hosts() -> list[HostAddress]:
    """Return the addresses at which racks of this machine listen, or to which they connect."""
    found: dict[HostAddress, None] = {}
    for name in racks():
        try:
            segment = Segment.attach(name)
        except SegmentError:
            continue
        lan = tomllib.loads(segment.config).get("adapter", {}).get("lan", {})
        segment.close()
        for endpoint in (*lan.get("listen", ()), *lan.get("connect", ())):
            if Endpoint.of(endpoint).is_private:
                continue
            found[HostAddress.of_endpoint(endpoint)] = None
    return list(found)


def _at(host: HostAddress, asker: Asker) -> Iterator[FoundRack]:
    try:
        with Questioner(host, asker) as questioner:
            names = questioner.racks()
    except Failure as failure:
        yield FoundRack(str(host), "", "", str(failure))
        return
    for name in names:
        try:
            with RemoteRack(RackAddress(host, name), asker) as rack:
                yield _described(str(host), rack)
        except (Failure, SegmentError) as error:
            yield FoundRack(str(host), name, "closed", str(error))


def _described(host: str, rack: RemoteRack) -> FoundRack:
    segment = rack.segment
    words = segment.words
    layout = segment.layout
    state = as_named(Run, words[System.STATE]).name.lower()
    peers = tuple(_peers(segment))
    boards = len({task.board for task in layout.tasks})
    shown = "".join(f", {name} {presence}" for name, presence in peers)
    age_s = (segment.realtime_ns - words[Head.CREATED_NS]) * 1e-9
    detail = f"{boards} boards, tick {words[System.TICK]}, launched {age_s:.0f} s ago{shown}"
    return FoundRack(host, layout.rack, state, detail, round(age_s, 3), peers)


def _peers(segment: Segment) -> Iterator[tuple[str, str]]:
    """Yield the racks that this one works with, and where each is."""
    lan = tomllib.loads(segment.config)["adapter"]["lan"]
    others = [entry["from"].partition("/")[0] for entry in lan.get("import", {}).values()]
    for name in dict.fromkeys([*others, *lan.get("peers", ())]):
        reading = open_observer(segment, f"lan.{peer_port(name)}").peek()
        presence = Presence(int(reading.value.presence)) if reading.is_there else Presence.AWAITED
        yield name, presence.name.lower()
