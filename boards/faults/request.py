"""From a fault as it is asked for to the entry of the fault table that holds it."""

from __future__ import annotations

from zlib import crc32

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout
from rack.boards.config.faults import fault_mistakes, places
from rack.boards.config.schema import RackConfig
from rack.boards.errors import ConfigError
from rack.boards.faults.bounds import cycle_ticks
from rack.boards.faults.condition import condition
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kinds import KINDS, NUMBERS, Kind

__all__ = ["cycle_ticks", "injection", "injections"]

SEEDS = 2**31
PHASES = 1000
"""Steps of a fault's phase in a tick."""


def injections(config: RackConfig, layout: Layout) -> tuple[Injection, ...]:
    """Return the faults of a config. Raises `ConfigError` with every mistake of every one."""
    mistakes = fault_mistakes(places(config), config, layout)
    if mistakes:
        raise ConfigError(mistakes)
    return tuple(_injection(fault, config, layout, place) for place, fault in places(config))


def injection(fault: FaultConfig, config: RackConfig, layout: Layout, place: str = "") -> Injection:
    """Return one fault, which stands at `place`: that tells its mistakes, and its seed where it has none of its own.

    Raises `ConfigError` with every mistake.
    """
    mistakes = fault_mistakes([(place, fault)], config, layout)
    if mistakes:
        raise ConfigError(mistakes)
    return _injection(fault, config, layout, place)


def _injection(fault: FaultConfig, config: RackConfig, layout: Layout, place: str) -> Injection:
    kind = KINDS[NUMBERS[fault.kind]]
    names = [task.name for task in layout.tasks]
    return Injection(
        kind=NUMBERS[fault.kind],
        task=-1 if fault.board == CLOCK else names.index(fault.board),
        mailbox=_mailbox(fault, kind, layout),
        tick=_first_tick(fault, layout.clock_ns),
        ticks=_ticks(fault, layout),
        phase=int(fault.phase * PHASES),
        # Two faults of one config must not throw the same dice.
        seed=crc32(f"{config.seed} {place}".encode()) % SEEDS if fault.seed is None else fault.seed,
        when=None if fault.when is None else condition(fault.when, layout),
        parameters=tuple(float(fault.parameters.get(p.name, p.default or 0.0)) for p in kind.parameters),
    )


def _mailbox(fault: FaultConfig, kind: Kind, layout: Layout) -> int:
    """Return the mailbox's place; -1: every one that the task writes, or none."""
    if fault.mailbox is None and kind.where != "bus":
        return -1
    named = (at for at, box in enumerate(layout.mailboxes) if box.name == fault.mailbox)
    # One message is forged, in one mailbox: the first that somebody reads.
    own = (at for at, box in enumerate(layout.mailboxes) if box.writer == fault.board and box.readers)
    return next(own if fault.mailbox is None else named, -1)


def _first_tick(fault: FaultConfig, clock_ns: int) -> int:
    if fault.at is not None:
        return round(fault.at * 1e9 / clock_ns)
    return -1 if fault.tick is None else fault.tick


def _ticks(fault: FaultConfig, layout: Layout) -> int:
    """Return how long a fault lasts; 0: to the end of the run, or only once."""
    if fault.cycles is not None:
        return fault.cycles * cycle_ticks(layout, fault.board)
    return 0 if fault.lasts is None else max(1, round(fault.lasts * 1e9 / layout.clock_ns))
