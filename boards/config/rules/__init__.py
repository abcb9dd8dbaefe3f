"""Rules between the tables of a config: functions that take the wiring and yield mistakes.

All mistakes are reported at once. A rule skips everything that depends on a broken table, because
the mistakes of that table are already reported. `rack.boards.config.injections` and
`rack.boards.config.commands` check faults and commands, which can also be issued to a running rack.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import ModuleType

from rack.boards.config.connections import Wiring
from rack.boards.config.rules import boards, levels, mailboxes
from rack.boards.config.schema import RackConfig
from rack.boards.errors import Mistake, Mistakes

STANDBYS = "rack.boards.config.rules.standbys"
"""Module with the rules of standbys. Only a rack with standbys loads it."""
NETWORK = "rack.boards.config.rules.lan"
"""Module with the rules of `[adapter.lan]`. Only a rack with a network loads it."""


def load_network_rules(config: RackConfig) -> ModuleType | None:
    """Return the module with the network rules. None for a rack without a network."""
    return None if config.adapter.lan is None else import_module(NETWORK)


def _check_network(wiring: Wiring) -> Mistakes:
    """Check the table `[adapter.lan]`, if the rack has one."""
    if (rules := load_network_rules(wiring.config)) is not None:
        yield from rules.check_network(wiring, wiring.config.adapter.lan)


def _check_standbys(wiring: Wiring) -> Mistakes:
    """Check the standbys of boards and clock, if the rack has any."""
    config = wiring.config
    keys = [board.standby or board.compare or board.vote for board in config.board.values()]
    if config.clock.standby is not None or any(keys):
        yield from import_module(STANDBYS).check_standbys(wiring)


Rule = Callable[[Wiring], Mistakes]
CLOCK_RULES: tuple[Rule, ...] = (
    boards.check_clock,
    boards.check_rates,
    boards.check_polling,
    boards.check_schedulers,
    boards.check_schedule,
)
"""Rules that depend on the table `[clock]`."""
RULES: tuple[Rule, ...] = (
    boards.check_boards,
    boards.check_circles,
    boards.check_slots,
    boards.check_run_end,
    _check_network,
    levels.check_scene,
    levels.check_robot,
    *CLOCK_RULES,
    mailboxes.check_strict,
    mailboxes.check_ports,
    mailboxes.check_exchange,
    mailboxes.check_writers,
    mailboxes.check_operator_mailboxes,
    mailboxes.check_read_mailboxes,
    mailboxes.check_protocol_tables,
    mailboxes.check_ending_status,
    mailboxes.check_sides,
    mailboxes.check_queues,
    mailboxes.check_asynchronous,
    mailboxes.check_interrupts,
    _check_standbys,
    levels.check_params,
    levels.check_programs,
    levels.check_cell,
)
"""All rules, in the order in which their mistakes are listed."""
NEEDS: Mapping[str, tuple[Rule, ...]] = {
    "clock": CLOCK_RULES,
    "robot": (levels.check_robot, levels.check_programs),
    "scene": (levels.check_scene, levels.check_programs),
    "task": (levels.check_programs,),
}
"""Rules that depend on a table. They are skipped if the table is broken."""


def apply_rules(wiring: Wiring) -> list[Mistake]:
    """Return all mistakes that the rules find in a wiring."""
    skipped = {rule for table in wiring.broken for rule in NEEDS.get(table, ())}
    return [mistake for rule in RULES if rule not in skipped for mistake in rule(wiring)]
