"""Injects faults, given in the form of a config, into a running rack and follows their state."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from rack.backplane.fault_table import NEVER, FaultEntry, FaultTable, Stage
from rack.backplane.process import set_priority
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.config import read_stored
from rack.boards.config.injections import build_live_injection
from rack.boards.config.mistakes import convert_errors
from rack.boards.config.published import PublishedRack
from rack.boards.errors import ConfigError, Mistake
from rack.boards.faults.config import FaultConfig, format_condition
from rack.boards.faults.describe import describe_fault, to_document
from rack.boards.faults.kind import KINDS
from rack.boards.faults.tasks import run_core_fault
from rack.tools.console.answer import Document, Failure
from rack.tools.console.held import describe_wait
from rack.tools.console.tables import format_fitted_table

BEGIN_S = 5.0
"""Maximum wait in s for a fault to begin at the next tick."""
POLL_S = 0.001
NEXT_TICK = "the next tick"
SEEDS = 2**31


class LiveRack:
    """Injects faults into a running rack."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._config = read_stored(segment.config)
        self._levels = PublishedRack.read_from_segment(segment).levels
        self._table = FaultTable(segment)

    def inject_fault(
        self, settings: Mapping[str, Any], wait: bool, timeout_s: float | None = None
    ) -> Document:
        """Inject a fault and return it as plain data.

        Without `wait`, the call returns when the fault has begun. If the fault has a tick or a
        condition, or if the rack is held, it returns at once.

        Args:
            settings: Keys of `[[fault]]`. Values of None are ignored.
            wait: Whether to wait until the fault is over.
            timeout_s: Maximum wall-clock time in s to wait for the end. None waits without limit.

        Raises:
            ConfigError: The fault has mistakes. All of them are reported.
            Failure: The run is over, or the fault does not begin or end in time.
        """
        if self._segment.run_is_over:
            raise Failure(f"rack '{self._segment.rack}': its run is over")
        fault = self._parse_fault(
            {key: value for key, value in settings.items() if value is not None}
        )
        checked = build_live_injection(fault, self._config, self._levels, self._segment.layout)
        self._check_fault(fault)
        entry = self._table.add_fault(checked)
        if KINDS[fault.kind].where == "core" and not self._config.is_lockstep:
            # For such a fault, this process itself occupies the core.
            self._print_waiting(entry)
            run_core_fault(self._segment, entry.index)
        elif fault.tick is None and fault.when is None:
            words = self._segment.words
            if not self._wait_until(
                lambda: entry.stage != Stage.WAITING or words[System.HELD] > 0, BEGIN_S
            ):
                why = f"the clock has not begun it within {BEGIN_S:g} s"
                raise Failure(f"{self._describe_fault(entry)}: {why}")
            if not words[System.HELD]:
                self._check_begun(entry)
        if wait:
            self._await_end(entry, timeout_s)
        return {**self._to_document(entry), "message": self._describe_state(entry)}

    def withdraw_fault(self, number: int) -> Document:
        """Withdraw a fault that waits for its tick or condition, and return it as plain data.

        Raises:
            Failure: The fault is not waiting, or begins before it can be withdrawn.
        """
        waiting = {entry.index: entry for entry in self._table.list_entries((Stage.WAITING,))}
        if number not in waiting:
            waiting_numbers = ", ".join(map(str, waiting)) or "none"
            raise Failure(f"fault {number} is not waiting; waiting: {waiting_numbers}", 2)
        entry = waiting[number]
        answer = self._to_document(entry)
        self._table.disarm_fault(entry)
        words = self._segment.words
        tick = words[System.TICK]
        # Wait until the fault can no longer begin. No fault begins while the clock is held.
        self._wait_until(lambda: words[System.TICK] > tick + 1 or words[System.HELD] > 0, BEGIN_S)
        if not self._table.free_entry(entry):
            raise Failure(
                f"{self._describe_fault(entry)}: it had begun before it could be withdrawn"
            )
        return {**answer, "stage": "free", "message": f"{answer['text']}: withdrawn"}

    def list_faults(self) -> list[Document]:
        """Return the faults injected so far, as plain data."""
        injected = self._table.list_entries((Stage.WAITING, Stage.ACTIVE, Stage.OVER))
        return [self._to_document(entry) for entry in injected]

    def format_table(self) -> Iterator[str]:
        """Yield the lines of a table of the faults injected so far."""
        columns = {
            "no": "fault",
            "fault": "text",
            "stage": "stage",
            "begins": "begins",
            "first acted": "struck_tick",
            "until": "until",
            "acted": "acted",
            "waits for": "waits_for",
        }
        rows = [
            [_format_cell(fault[key]) for key in columns.values()] for fault in self.list_faults()
        ]
        return format_fitted_table(list(columns), rows)

    def _parse_fault(self, settings: Document) -> FaultConfig:
        """Parse the keys of a fault. If they contain no seed, choose a new one.

        Raises:
            ConfigError: A key or a value is invalid.
        """
        # Two faults of one run must not draw the same random numbers.
        settings.setdefault(
            "seed", (self._config.seed + self._segment.words[System.INJECTED]) % SEEDS
        )
        try:
            # Values from a command line are strings, so allow conversion from strings to numbers.
            return FaultConfig.model_validate(settings, strict=False)
        except ValidationError as error:
            raise ConfigError(convert_errors(error, FaultConfig, settings)) from None

    def _check_fault(self, fault: FaultConfig) -> None:
        """Check that this process can inject a fault into a running rack.

        Raises:
            ConfigError: The fault cannot begin in a running rack, or has no end but needs one.
            Failure: This process is not permitted to occupy a core.
        """
        tick = self._segment.tick
        where = KINDS[fault.kind].where
        if where == "start":
            why = (
                "a running rack has passed its self-tests; give it in the config or with 'rack run"
                " --faults'"
            )
            raise ConfigError([Mistake("kind", fault.kind, why)])
        if fault.tick is not None and fault.tick <= tick:
            why = f"has passed; the rack is at tick {tick}"
            raise ConfigError([Mistake("tick", fault.tick, why)])
        if where != "core":
            return
        if fault.lasts is None and fault.cycles is None:
            why = f"missing; a {fault.kind} must have an end: --for or --cycles"
            raise ConfigError([Mistake("for", None, why)])
        if self._config.is_lockstep:
            return
        if not set_priority(1):
            why = "SCHED_FIFO is refused to this user; no core can be taken from a board"
            raise Failure(f"{fault.kind}: {why}")
        set_priority(0)

    def _wait_until(self, holds: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait until a condition holds or the run is over. Return False after `timeout_s`."""
        deadline = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while not holds() and not self._segment.run_is_over:
            if time.monotonic() > deadline:
                return False
            time.sleep(POLL_S)
        return True

    def _await_end(self, entry: FaultEntry, timeout_s: float | None) -> None:
        """Wait until a fault, or the run, is over.

        Raises:
            Failure: `timeout_s` has passed, or the run has ended before the fault began.
        """
        self._print_waiting(entry)
        if not self._wait_until(lambda: entry.stage == Stage.OVER, timeout_s):
            raise Failure(f"timed out after {timeout_s:g} s: {self._describe_state(entry)}")
        self._check_begun(entry)

    def _print_waiting(self, entry: FaultEntry) -> None:
        """If a fault has not begun, print the tick or condition for which it waits."""
        if entry.stage == Stage.WAITING:
            print(self._describe_state(entry), file=sys.stderr, flush=True)

    def _check_begun(self, entry: FaultEntry) -> None:
        """Raise `Failure` if the run has ended before a fault began."""
        if entry.stage == Stage.WAITING:
            raise Failure(f"{self._describe_fault(entry)}: the run ended before it began")

    def _describe_state(self, entry: FaultEntry) -> str:
        """Describe a fault and its state in one line."""
        fault = self._describe_fault(entry)
        first = entry.tick
        last = entry.until - 1
        if entry.stage == Stage.WAITING:
            how = f"to withdraw it: rack inject {self._segment.rack} --withdraw {entry.index}"
            awaited = self._describe_awaited(entry)
            hold_text = describe_wait(self._segment) if awaited == NEXT_TICK else ""
            return f"{fault}: armed, {hold_text or f'waits for {awaited}'}; {how}"
        if entry.stage == Stage.OVER:
            acted = "once" if entry.count == 1 else f"{entry.count} times"
            return f"{fault}: ticks {first} to {last}, acted {acted}"
        end = "the end of the run" if entry.until == NEVER else f"tick {last}"
        return f"{fault}: from tick {first} to {end}"

    def _describe_awaited(self, entry: FaultEntry) -> str:
        """Return the tick or the condition for which a fault waits."""
        if entry.when_box < 0:
            if entry.tick <= 0:
                return NEXT_TICK
            tick = self._segment.tick
            return f"tick {entry.tick}; the rack is at tick {tick}"
        when = (entry.when_box, entry.when_field, entry.when_value)
        return format_condition(when, self._segment.layout)

    def _to_document(self, entry: FaultEntry) -> Document:
        """Return a fault as plain data. `waits_for` is empty once it has begun."""
        waits_for = self._describe_awaited(entry) if entry.stage == Stage.WAITING else ""
        return {
            **to_document(entry, self._segment.layout, self._config.joints),
            "waits_for": waits_for,
        }

    def _describe_fault(self, entry: FaultEntry) -> str:
        """Describe a fault in one line."""
        return describe_fault(entry, self._segment.layout, self._config.joints)


def _format_cell(value: str | int | None) -> str:
    """Format a value for the table of faults. An unknown tick (None or -1) becomes "-"."""
    return "-" if value is None or value == -1 else str(value)
