"""Rules for standbys, further copies of executors: see `rack.backplane.standby`."""

from __future__ import annotations

import os

from rack.boards.config.connections import TaskPorts, Wiring
from rack.boards.config.schedulers import names_scheduler
from rack.boards.errors import Mistake, Mistakes
from rack.boards.host.adapter import Adapter
from rack.levels.level import Executor

VOTERS = 2
"""Number of standbys that a vote needs."""
HELD_BACK = ("time-slice", "double-buffer")
"""Protocols of mailboxes that standbys can read, and whose messages they can hold back."""


def check_standbys(wiring: Wiring) -> Mistakes:
    """Check that each standby has a core of this machine, and that its level can be replicated."""
    config = wiring.config
    # A campaign checks configs in processes that are pinned to one core.
    cores = range(os.cpu_count() or 1)
    for place, standby in config.list_standby_tables():
        if standby.core not in cores:
            why = f"this machine has no such core; cores: {', '.join(map(str, cores))}"
            yield Mistake(f"{place}.core", standby.core, why)
    executors = {p.task: p for p in wiring.tasks if issubclass(p.kind, Executor)}
    for name, board in config.board.items():
        place = f"board.{name}"
        count = len(board.standby)
        for key in ("compare", "vote"):
            if getattr(board, key) and not count:
                yield Mistake(f"{place}.{key}", True, f"needs {place}.standby, which is missing")
        if count > VOTERS:
            why = f"{count} standbys; at most {VOTERS} are possible"
            yield Mistake(f"{place}.standby", None, why)
        elif board.vote and 0 < count < VOTERS:
            why = f"a vote needs 3 copies, but there are {count + 1}; give {VOTERS} standbys"
            yield Mistake(f"{place}.vote", True, why)
        if count and name in executors and (why := _find_obstacle(wiring, executors[name])):
            yield Mistake(f"{place}.standby", None, why)


def _find_obstacle(wiring: Wiring, ports: TaskPorts) -> str:
    """Return why a level cannot have a standby. Empty if it can."""
    config = wiring.config
    kind = ports.kind
    if issubclass(kind, Adapter):
        return f"class {kind.__name__} connects the rack with others, which one process must do"
    if names_scheduler(config):
        return "the config names a scheduler; a standby needs fixed priorities"
    if ports.exchange:
        return "the board has an exchange table, which a standby cannot have"
    for mailbox in dict.fromkeys((*ports.writes.values(), *(box for _, box in ports.sources))):
        protocol = wiring.find_protocol(mailbox)
        if wiring.is_known(mailbox) and protocol not in HELD_BACK:
            return (
                f"mailbox '{mailbox}' has protocol {protocol}; all mailboxes of a level with a"
                f" standby need {' or '.join(HELD_BACK)}"
            )
    timed = next((port for port, output in ports.outputs.items() if output.max_age_s), "")
    if timed:
        return f"port '{timed}' is written on demand, and a standby writes in every cycle"
    assert issubclass(kind, Executor), "only executors have standbys"
    return kind.find_standby_obstacle(config.board[ports.place.board].params)
