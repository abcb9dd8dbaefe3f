"""Joint timing model of racks that exchange messages, built from their configs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from rack.backplane.layout import Layout, TickGrid
from rack.backplane.message import Command
from rack.boards.config.loader import load
from rack.boards.config.resolved import resolve_layout
from rack.boards.config.schema import LAN, RackConfig
from rack.boards.config.timing import NS_PER_MS, build_rack_timing
from rack.boards.errors import ConfigError, Mistake
from rack.boards.timing.joined import JoinedRacks, RackLink, Station

COMMAND_FIELDS = {(field.name, field.meaning) for field in Command.message_type.fields}
"""Names and meanings of the fields that every command has."""


def load_partners(config: RackConfig) -> list[RackConfig]:
    """Load the configs of racks that a config launches or names as partners.

    They get the clock mode and the speed of this config. The result is empty for a rack without a
    network.

    Raises:
        ConfigError: A config has mistakes.
    """
    table = config.adapter.lan
    if table is None:
        return []
    overrides = [f"clock.mode={config.clock.mode}", f"clock.speed={config.clock.speed}"]
    return [load(name, overrides) for name in dict.fromkeys((*table.launch, *table.partners))]


def join_racks(
    configs: Sequence[RackConfig], layouts: Mapping[str, Layout] | None = None
) -> JoinedRacks:
    """Build the joint timing model of several racks.

    Args:
        configs: Valid configs of racks with different names.
        layouts: Layouts of the racks. None to compute them, which imports the racks' levels.

    Raises:
        ConfigError: An import from one of these racks names a mailbox that the rack does not
            export.
    """
    members = {config.name: config for config in configs}
    layouts = layouts or {name: resolve_layout(config) for name, config in members.items()}
    timings = {name: build_rack_timing(members[name], layout) for name, layout in layouts.items()}
    return JoinedRacks(timings, layouts, tuple(_list_links(members, layouts)))


def _list_links(
    members: Mapping[str, RackConfig], layouts: Mapping[str, Layout]
) -> Iterator[RackLink]:
    """Yield a link for each mailbox that one of the racks imports from another."""
    for name, member in members.items():
        table = member.adapter.lan
        for port, entry in () if table is None else table.imports.items():
            source = members.get(entry.rack)
            if source is None:
                continue
            lan = source.adapter.lan
            exported = {} if lan is None else {e.source: e for e in lan.exports.values()}
            if entry.mailbox not in exported:
                place = f"rack {name}: adapter.lan.import.{port}.from"
                listed = ", ".join(exported) or "none"
                why = f"rack '{entry.rack}' does not export this mailbox; its exports: {listed}"
                raise ConfigError([Mistake(place, entry.source, why)])
            layout = layouts[name]
            box = layout.find_mailbox(f"{LAN}.{port}")
            yield RackLink(
                source=Station(entry.rack, layouts[entry.rack].find_mailbox(entry.mailbox).writer),
                mailbox=entry.mailbox,
                rack=name,
                port=port,
                readers=box.readers,
                is_command={(field.name, field.meaning) for field in box.fields} >= COMMAND_FIELDS,
                exported=_compute_grid(layouts[entry.rack], exported[entry.mailbox].rate_hz),
                imported=_compute_grid(layout, entry.rate_hz),
                adapter_ns=layout.find_task(LAN).every * layout.clock_ns,
                delay_ns=None if entry.delay_ms is None else round(entry.delay_ms * NS_PER_MS),
                max_lost=entry.max_lost,
            )


def _compute_grid(layout: Layout, rate_hz: float) -> TickGrid:
    """Return the times, in ns, of exchanges that a rack's adapter makes at `rate_hz`."""
    adapter = layout.find_task(LAN).grid
    cycle_ns = adapter.every * layout.clock_ns
    return TickGrid(round(1e9 / (rate_hz * cycle_ns)) * cycle_ns, adapter.phase * layout.clock_ns)
