"""Joins the timing of racks that exchange messages, from their configs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from rack.backplane.layout import Layout, TickGrid
from rack.backplane.message import Command
from rack.boards.config.loader import load
from rack.boards.config.resolved import resolve_layout
from rack.boards.config.schema import LAN, RackConfig
from rack.boards.config.timing import NS_PER_MS, build_rack_timing
from rack.boards.errors import ConfigError, Mistake
from rack.boards.timing.joined import JoinedRacks, RackLink, Station


@dataclass(frozen=True)
class JoinedMember:
    """One of several racks: its config and its layout."""

    config: RackConfig
    layout: Layout

    def compute_exchange_grid(self, rate_hz: float) -> TickGrid:
        """Return the times in ns at which the adapter exchanges messages at a rate."""
        clock_ns = self.layout.clock_ns
        adapter = self.layout.find_task(LAN).grid
        cycles = round(1e9 / (rate_hz * adapter.every * clock_ns))
        return TickGrid(cycles * adapter.every * clock_ns, adapter.phase * clock_ns)


def load_partners(config: RackConfig) -> list[RackConfig]:
    """Load the racks that a config launches or names as partners, with its clock mode and speed.

    Raises:
        ConfigError: A config has mistakes.
    """
    table = config.adapter.lan
    if table is None:
        return []
    overrides = [f"clock.mode={config.clock.mode}", f"clock.speed={config.clock.speed}"]
    return [load(name, overrides) for name in dict.fromkeys((*table.launch, *table.partners))]


def join_racks(configs: Sequence[RackConfig]) -> JoinedRacks:
    """Join the timing of racks.

    Args:
        configs: Valid configs of racks with different names.

    Raises:
        ConfigError: An import from one of these racks names a mailbox that the rack does not
            export.
    """
    members = {config.name: JoinedMember(config, resolve_layout(config)) for config in configs}
    timings = {
        name: build_rack_timing(member.config, member.layout) for name, member in members.items()
    }
    layouts = {name: member.layout for name, member in members.items()}
    return JoinedRacks(timings, layouts, tuple(_list_links(members)))


def _list_links(members: Mapping[str, JoinedMember]) -> Iterator[RackLink]:
    """Yield a link for each mailbox that one of the racks imports from another."""
    for name, member in members.items():
        table = member.config.adapter.lan
        for port, entry in () if table is None else table.imports.items():
            source = members.get(entry.rack)
            if source is None:
                continue
            lan = source.config.adapter.lan
            exported = {} if lan is None else {e.source: e for e in lan.exports.values()}
            if entry.mailbox not in exported:
                place = f"rack {name}: adapter.lan.import.{port}.from"
                listed = ", ".join(exported) or "none"
                why = f"rack '{entry.rack}' does not export this mailbox; its exports: {listed}"
                raise ConfigError([Mistake(place, entry.source, why)])
            clock_ns = member.layout.clock_ns
            yield RackLink(
                source=Station(entry.rack, source.layout.find_mailbox(entry.mailbox).writer),
                mailbox=entry.mailbox,
                rack=name,
                port=port,
                readers=member.layout.find_mailbox(f"{LAN}.{port}").readers,
                is_command=issubclass(entry.find_message_class(), Command),
                exported=source.compute_exchange_grid(exported[entry.mailbox].rate_hz),
                imported=member.compute_exchange_grid(entry.rate_hz),
                adapter_ns=member.layout.find_task(LAN).every * clock_ns,
                delay_ns=None if entry.delay_ms is None else round(entry.delay_ms * NS_PER_MS),
                max_lost=entry.max_lost,
            )
