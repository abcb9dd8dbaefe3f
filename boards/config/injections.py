"""Faults of a config: checks against their kinds and the rack, and entries of the fault table."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from zlib import crc32

from rack.backplane.address_map import CLOCK, FAULT_ENTRIES
from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout, Role
from rack.backplane.mailbox.queue import is_position_mailbox
from rack.boards.config.mistakes import format_place
from rack.boards.config.published import Levels
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import compute_first_tick
from rack.boards.errors import ConfigError, Mistake, Mistakes
from rack.boards.faults.bounds import cycle_ticks
from rack.boards.faults.clock_board import PHASES
from rack.boards.faults.config import FaultConfig, parse_condition
from rack.boards.faults.kind import KINDS, Kind, Parameter
from rack.levels.tables import RobotConfig

SEEDS = 2**31
"""Number of possible seeds of a fault."""


def find_fault_mistakes(
    faults: Iterable[tuple[str, FaultConfig]],
    config: RackConfig,
    levels: Levels,
    layout: Layout | None = None,
    unspecified: Collection[str] = (),
) -> list[Mistake]:
    """Return every mistake in faults.

    Args:
        faults: Pairs of a fault's place in the config, as in "fault[0]", and the fault. The place
            of a live fault is "".
        config: The config of the rack.
        levels: Its levels.
        layout: Its layout. None skips the checks that need one.
        unspecified: Boards with known mistakes. Checks that depend on them are skipped.
    """
    rules = [
        FaultCheck(place, fault, config, levels, layout, unspecified) for place, fault in faults
    ]
    mistakes = [mistake for rule in rules for mistake in rule.find_mistakes()]
    if len(rules) > FAULT_ENTRIES:
        mistakes.append(
            Mistake("fault", len(rules), f"too many faults; a run can have at most {FAULT_ENTRIES}")
        )
    return mistakes


@dataclass(frozen=True)
class FaultCheck:
    """Checks of one fault.

    Attributes:
        place: Place of the fault in the config. Empty for a live fault.
        fault: The fault.
        config: The config of the rack.
        levels: Its levels.
        layout: Its layout. None skips the checks that need one.
        broken_boards: Boards with known mistakes. Checks that depend on them are skipped.
    """

    place: str
    fault: FaultConfig
    config: RackConfig
    levels: Levels
    layout: Layout | None
    broken_boards: Collection[str]

    def find_mistakes(self) -> Mistakes:
        """Yield every mistake in the fault."""
        # At most one key may give the start of the fault, and at most one its duration.
        for keys in (("tick", "at", "when"), ("for", "cycles")):
            given_keys = [key for key in keys if self._get_value(key) is not None]
            for key in given_keys[1:]:
                yield self._build_mistake(
                    key, f"{given_keys[0]} is also given; give only one of {', '.join(keys)}"
                )
        fault = self.fault
        config = self.config
        tasks = {place.name: place.role for place in (*config.list_tasks(), *config.list_hosts())}
        # Whatever strikes an executor strikes its standbys too.
        tasks |= {place.name: "executor" for place in config.list_standbys()}
        kind = KINDS.names.get(fault.kind)
        if kind is None:
            yield self._build_mistake("kind", f"no such kind; kinds: {', '.join(KINDS.names)}")
        else:
            yield from self._check_keys(kind)
        if fault.board != CLOCK and fault.board not in tasks:
            if fault.board.partition(".")[0] not in self.broken_boards:
                yield self._build_mistake(
                    "board", f"no such task; tasks: {', '.join([*tasks, CLOCK])}"
                )
        elif kind is not None:
            of_task = self._explain_unsuitable_task(kind, tasks)
            if why := of_task or self._explain_unsuitable_mailbox(kind):
                yield self._build_mistake("board" if of_task else "mailbox", why)
        if fault.when is not None and (layout := self._find_layout(fault.when)) is not None:
            try:
                parse_condition(fault.when, layout)
            except LookupError as error:
                yield self._build_mistake("when", str(error.args[0]))

    def _check_keys(self, kind: Kind) -> Mistakes:
        """Yield a mistake for each key and parameter that this kind of fault does not accept."""
        fault = self.fault
        within_tick = _format_names(other.name for other in KINDS if other.within_tick)
        of_mailboxes = _format_names(other.name for other in KINDS if other.takes_mailbox)
        for is_refused, keys, why in (
            (
                kind.realtime and self.config.is_lockstep,
                ("kind",),
                "needs real time: in lockstep time waits for every task; run without --lockstep",
            ),
            (kind.once, ("for", "cycles"), "strikes once and has no duration; remove it"),
            (
                kind.where == "start",
                ("tick", "at", "when"),
                "strikes as the board starts; remove it",
            ),
            (
                fault.phase and not kind.within_tick,
                ("phase",),
                f"cannot strike within a tick; kinds that can: {within_tick}",
            ),
            (
                not kind.takes_mailbox,
                ("mailbox",),
                f"does not affect mailboxes; kinds that do: {of_mailboxes}",
            ),
        ):
            for key in keys if is_refused else ():
                if self._get_value(key) is not None:
                    yield self._build_mistake(key, f"{kind.name} {why}")
        known = {parameter.name: parameter for parameter in kind.parameters}
        for name, value in fault.parameters.items():
            why = f"{kind.name} has no such parameter; parameters: {_format_names(known)}"
            if name in known:
                why = _explain_invalid_value(known[name], value, self.config.robot)
            if why:
                plain = int(value) if value.is_integer() else value
                yield Mistake(format_place(self.place, name), plain, why)
        for name, parameter in known.items():
            if parameter.default is None and name not in fault.parameters:
                yield Mistake(format_place(self.place, name), None, f"missing; {parameter}")

    def _explain_unsuitable_task(self, kind: Kind, tasks: Mapping[str, Role]) -> str:
        """Return the reason why this kind of fault cannot affect the fault's task. Empty if it can.

        Args:
            kind: The kind of fault.
            tasks: Roles of all tasks and host boards, by name.
        """
        board = self.fault.board
        if board in self.config.host and self.config.host[board].external:
            return "the rack does not start this external board, so it has no process to strike"
        if board == CLOCK:
            kinds = _format_names(other.name for other in KINDS if "clock" in other.tasks)
            why = f"{kind.name} cannot strike the clock; kinds that can: {kinds}"
            return "" if "clock" in kind.tasks else why
        if kind.tasks == ("clock",):
            return f'{kind.name} strikes only the clock; must be "{CLOCK}"'
        if tasks[board] not in kind.tasks:
            role = kind.tasks[0]
            fitting = _format_names(name for name, other in tasks.items() if other == role)
            return f"{kind.name} strikes only {role}s; {role}s: {fitting}"
        if kind.where == "arm":
            able = [
                name
                for name in self.config.board
                # Assume that a level whose class is missing can be affected.
                if name not in self.levels or kind.name in self.levels[name].struck_by
            ]
            if board not in able:
                names = _format_names(able)
                return f"{kind.name} cannot strike this board; boards that it can: {names}"
        return ""

    def _find_layout(self, place: str) -> Layout | None:
        """Return the layout, or None if there is none or it lacks the board of `place`.

        Args:
            place: Name of a task or mailbox, or a condition that begins with one.
        """
        is_known = place.partition(".")[0].strip() not in self.broken_boards
        return self.layout if is_known else None

    def _explain_unsuitable_mailbox(self, kind: Kind) -> str:
        """Return the reason why this kind of fault cannot affect the mailbox. Empty if it can.

        A fault without a mailbox affects all mailboxes that its task writes.
        """
        board = self.fault.board
        mailbox = self.fault.mailbox
        layout = self._find_layout(board)
        if layout is None or board == CLOCK or not kind.takes_mailbox:
            return ""
        # A queue's position mailbox has no port, so only bus faults can affect it.
        written = {
            m.name: m
            for m in layout.mailboxes
            if m.writer == layout.find_first_copy(board)
            and (kind.where == "bus" or not is_position_mailbox(m))
        }
        struck = [m for m in written.values() if mailbox in (None, m.name)]
        if mailbox is not None and not struck:
            return f"'{board}' does not write it; it writes: {_format_names(written)}"
        if kind.not_queued and struck and all(m.protocol == "queue" for m in struck):
            why = f"'{struck[0].name}' is a queue, which {kind.name} does not strike"
            return f"{why}: {kind.not_queued}"
        # Boards that are missing from the layout may read the mailbox.
        if kind.takes_one_mailbox and mailbox is None and not self.broken_boards:
            has_reader = any(m.readers for m in struck)
            return "" if has_reader else f"missing; no mailbox of '{board}' has a reader"
        number = self.fault.parameters.get("field", -1)
        if kind.where == "copy" and any(number >= len(m.fields) for m in struck):
            return f"'{struck[0].name}' has no field {number:g}; it has {len(struck[0].fields)}"
        locked = [m.name for m in written.values() if m.protocol == "lock"]
        if kind.where == "lock" and (not locked or mailbox not in (None, *locked)):
            why = f"{kind.name} needs protocol lock; mailboxes of '{board}' that use it"
            return f"{why}: {_format_names(locked)}"
        return ""

    def _get_value(self, key: str) -> object:
        """Return the fault's value for a key of its `[[fault]]` table. None if it is not given."""
        return self.fault.lasts if key == "for" else getattr(self.fault, key)

    def _build_mistake(self, key: str, why: str) -> Mistake:
        """Return a mistake about one key of the fault."""
        return Mistake(format_place(self.place, key), self._get_value(key), why)


def _explain_invalid_value(parameter: Parameter, value: float, robot: RobotConfig | None) -> str:
    """Return the reason why a value of the parameter is invalid. Empty if it is valid."""
    upper_bound = parameter.most
    if parameter.name == "joint" and robot is not None:
        upper_bound = len(robot.joints) - 1
    if not parameter.least <= value <= upper_bound or (parameter.is_whole and value != int(value)):
        whole = "whole numbers " if parameter.is_whole else ""
        return f"out of range; valid: {whole}{parameter.least:g} to {upper_bound:g}; {parameter}"
    return ""


def _format_names(names: Iterable[str]) -> str:
    """Return names separated by commas, or "none"."""
    return ", ".join(names) or "none"


def list_faults(config: RackConfig) -> list[tuple[str, FaultConfig]]:
    """Return each fault of a config with its place, as in "fault[0]"."""
    return [(f"fault[{at}]", fault) for at, fault in enumerate(config.fault)]


def build_injections(config: RackConfig, layout: Layout) -> tuple[Injection, ...]:
    """Return the fault table's entries for the faults of a checked config."""
    return tuple(
        _build_injection(fault, config, layout, place) for place, fault in list_faults(config)
    )


def build_live_injection(
    fault: FaultConfig, config: RackConfig, levels: Levels, layout: Layout
) -> Injection:
    """Check a fault that is injected live and return its entry for the fault table.

    Args:
        fault: The fault.
        config: Config of the running rack.
        levels: Levels that the rack has published.
        layout: Layout of its segment.

    Raises:
        ConfigError: The fault has mistakes. All of them are listed.
    """
    if mistakes := find_fault_mistakes([("", fault)], config, levels, layout):
        raise ConfigError(mistakes)
    return _build_injection(fault, config, layout, "")


def _build_injection(
    fault: FaultConfig, config: RackConfig, layout: Layout, place: str
) -> Injection:
    """Return the fault table's entry for one fault of a checked config, or for a live fault."""
    kind = KINDS[fault.kind]
    names = [process.name for process in layout.processes]
    mailbox = -1
    if fault.mailbox is not None:
        mailbox = layout.find_mailbox_index(fault.mailbox)
    elif kind.takes_one_mailbox:
        mailbox = next(
            at
            for at, box in enumerate(layout.mailboxes)
            if box.writer == layout.find_first_copy(fault.board) and box.readers
        )
    seed = fault.seed
    if seed is None:
        # Two faults of one config must draw different random numbers.
        seed = crc32(f"{config.seed} {place}".encode()) % SEEDS
    # Zero ticks mean that the fault lasts until the end of the run, or that it occurs only once.
    ticks = 0
    if fault.cycles is not None:
        ticks = fault.cycles * cycle_ticks(layout, fault.board)
    elif fault.lasts is not None:
        ticks = max(1, layout.to_ticks(fault.lasts))
    return Injection(
        kind=kind.number,
        task=-1 if fault.board == CLOCK else names.index(fault.board),
        mailbox=mailbox,
        tick=compute_first_tick(fault, layout),
        ticks=ticks,
        phase=int(fault.phase * PHASES),
        seed=seed,
        when=None if fault.when is None else parse_condition(fault.when, layout),
        parameters=tuple(
            float(fault.parameters.get(p.name, p.default or 0.0)) for p in kind.parameters
        ),
    )
