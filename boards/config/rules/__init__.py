"""Rules between the tables of a config: functions that take the wiring and yield mistakes.

All mistakes are reported at once. A rule skips everything that depends on a broken table, because
the mistakes of that table are already reported. `rack.boards.config.injections` and
`rack.boards.config.commands` check faults and commands, which may also come while a rack runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import ModuleType

from rack.boards.config.connections import Wiring
from rack.boards.config.rules import boards, levels, mailboxes
from rack.boards.config.schema import RackConfig
from rack.boards.errors import Mistake, Mistakes

NETWORK = "rack.boards.config.rules.lan"
"""Module with the rules of `[adapter.lan]`. Only a rack with a network loads it."""


def network_rules(config: RackConfig) -> ModuleType | None:
    """Return the module with the network rules. None for a rack without a network."""
    return None if config.adapter.lan is None else import_module(NETWORK)


def _network(wiring: Wiring) -> Mistakes:
    if (rules := network_rules(wiring.config)) is not None:
        yield from rules.check_network(wiring, wiring.config.adapter.lan)


Rule = Callable[[Wiring], Mistakes]
RULES: tuple[Rule, ...] = (
    boards.boards,
    boards.hosts,
    boards.circles,
    boards.slots,
    boards.ends,
    boards.record,
    _network,
    levels.scene,
    levels.robot,
    boards.clock,
    boards.rates,
    boards.polling,
    boards.reservations,
    boards.schedule,
    mailboxes.strict,
    mailboxes.ports,
    mailboxes.exchange,
    mailboxes.writers,
    mailboxes.operated,
    mailboxes.reads,
    mailboxes.mailboxes,
    mailboxes.statuses,
    mailboxes.sides,
    mailboxes.queues,
    mailboxes.asynchronous,
    mailboxes.interrupts,
    levels.params,
    levels.programs,
    levels.cell,
)
"""All rules, in the order in which their mistakes are listed."""
NEEDS: Mapping[Rule, set[str]] = {
    levels.scene: {"scene"},
    levels.robot: {"robot"},
    boards.clock: {"clock"},
    boards.rates: {"clock"},
    boards.polling: {"clock"},
    boards.reservations: {"clock"},
    boards.schedule: {"clock"},
    levels.programs: {"robot", "scene", "task"},
}
"""Tables that a rule depends on. The rule is skipped if one of them is broken."""


def broken_rules(wiring: Wiring) -> list[Mistake]:
    """Return the mistakes that all applicable rules find in a wiring."""
    rules = (rule for rule in RULES if not wiring.broken & NEEDS.get(rule, set()))
    return [mistake for rule in rules for mistake in rule(wiring)]
