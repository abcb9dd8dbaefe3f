"""What a rack gets from outside of it: such a rack repeats itself only with what came then."""

from __future__ import annotations

from rack.boards.config.schema import LAN, RackConfig


def outside(config: RackConfig) -> str:
    """Return whose state is not the rack's, so that it has no snapshots; empty: nobody's."""
    hosts = ", ".join(map(repr, config.host))
    found = [f"{hosts}: a host program's state"] if hosts else []
    found += [f"'{LAN}': what comes from the network"] if config.adapter.lan is not None else []
    return "; ".join(found)
