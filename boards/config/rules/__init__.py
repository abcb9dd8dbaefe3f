"""The rules that the tables of a config keep between them, a file a subject: functions from the
wiring to mistakes.

All mistakes are reported at once. A rule skips what depends on a broken table, whose own mistakes
are already reported. Faults and commands, which may come live too, have rules of their own:
`rack.boards.config.injections` and `rack.boards.config.commands`.
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
"""The rules of `[adapter.lan]`, by name: a rack without a network loads neither them nor what they
know of certificates."""


def network_rules(config: RackConfig) -> ModuleType | None:
    """Return the module with the rules of a rack's network; None for a rack without one."""
    return None if config.adapter.lan is None else import_module(NETWORK)


def _network(wiring: Wiring) -> Mistakes:
    if (rules := network_rules(wiring.config)) is not None:
        yield from rules.network(wiring, wiring.config.adapter.lan)


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
"""Every rule, in the order in which mistakes are listed."""
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
"""The tables without which a rule says nothing."""


def broken_rules(wiring: Wiring) -> list[Mistake]:
    """Return every mistake in a wiring."""
    kept = (rule for rule in RULES if not wiring.broken & NEEDS.get(rule, set()))
    return [mistake for rule in kept for mistake in rule(wiring)]
