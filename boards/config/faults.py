"""Fault tables made into entries of the fault table, once their rules are kept."""

from __future__ import annotations

from zlib import crc32

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout
from rack.boards.config.published import Levels
from rack.boards.config.rules.faults import fault_mistakes
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import first_tick
from rack.boards.errors import ConfigError
from rack.boards.faults.bounds import cycle_ticks
from rack.boards.faults.clock_board import PHASES
from rack.boards.faults.config import FaultConfig, condition
from rack.boards.faults.kind import KINDS, Kind

SEEDS = 2**31


def places(config: RackConfig) -> list[tuple[str, FaultConfig]]:
    """Return the faults of a config with their places in it."""
    return [(f"fault[{at}]", fault) for at, fault in enumerate(config.fault)]


def injections(config: RackConfig, layout: Layout) -> tuple[Injection, ...]:
    """Return the entries of a config's own faults, already checked by `fault_mistakes`."""
    return tuple(_injection(fault, config, layout, place) for place, fault in places(config))


def injection(fault: FaultConfig, config: RackConfig, levels: Levels, layout: Layout) -> Injection:
    """Return the entry of a fault injected live. Raises `ConfigError` with every mistake."""
    if mistakes := fault_mistakes([("", fault)], config, levels, layout):
        raise ConfigError(mistakes)
    return _injection(fault, config, layout, "")


def _injection(fault: FaultConfig, config: RackConfig, layout: Layout, place: str) -> Injection:
    kind = KINDS[fault.kind]
    names = [process.name for process in layout.processes]
    task = -1 if fault.board == CLOCK else names.index(fault.board)
    seed = fault.seed
    if seed is None:
        # Two faults of one config must not draw the same random numbers.
        seed = crc32(f"{config.seed} {place}".encode()) % SEEDS
    when = None if fault.when is None else condition(fault.when, layout)
    return Injection(
        kind=kind.number,
        task=task,
        mailbox=_mailbox(fault, kind, layout),
        tick=first_tick(fault, layout.clock_ns),
        ticks=_ticks(fault, layout),
        phase=int(fault.phase * PHASES),
        seed=seed,
        when=when,
        parameters=tuple(
            float(fault.parameters.get(p.name, p.default or 0.0)) for p in kind.parameters
        ),
    )


def _mailbox(fault: FaultConfig, kind: Kind, layout: Layout) -> int:
    """Return the index of the mailbox; -1: all that the task writes, or none."""
    if fault.mailbox is None and kind.where != "bus":
        return -1
    boxes = enumerate(layout.mailboxes)
    if fault.mailbox is None:
        # One message is forged, in one mailbox: by default the first that has a reader.
        found = (at for at, box in boxes if box.writer == fault.board and box.readers)
    else:
        found = (at for at, box in boxes if box.name == fault.mailbox)
    return next(found, -1)


def _ticks(fault: FaultConfig, layout: Layout) -> int:
    """Return the duration of a fault; 0: until the end of the run, or it strikes once."""
    if fault.cycles is not None:
        return fault.cycles * cycle_ticks(layout, fault.board)
    return 0 if fault.lasts is None else max(1, round(fault.lasts * 1e9 / layout.clock_ns))
