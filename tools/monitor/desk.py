"""Gives commands to the levels of a running rack and waits for their replies."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from rack.backplane.operator_table import (
    Client,
    OperatorTable,
    Request,
    RequestEntry,
    RequestStage,
)
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Scheduler, System
from rack.boards.config import read_stored
from rack.boards.config.command import CommandConfig
from rack.boards.config.commands import build_request, describe_commands, parse_command
from rack.boards.config.published import PublishedRack
from rack.boards.errors import ConfigError, Mistake
from rack.boards.operator import copy_request_message, describe_command
from rack.levels.operator import EFFECTS, Operation
from rack.tools.console.answer import Document, Failure
from rack.tools.console.held import describe_wait
from rack.tools.console.tables import format_fitted_table
from rack.tools.monitor.holds import format_resume_command
from rack.tools.monitor.newest_messages import NewestMessages
from rack.tools.monitor.replies import Reply, ReplyDeadline, ReplyReader, find_answering_status

MAX_SILENCE_S = 5.0
"""Time without a tick after which a wait fails."""
EXPLAIN_AFTER_S = 1.5
"""Time after which a wait is explained on stderr."""
CHECK_INTERVAL_S = 0.001
"""Time between two checks of the rack."""
GOAL_KEYS = ("joints", "position", "quaternion", "direction")


class LevelCommander:
    """Gives an operator's commands to the levels of one rack."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._config = read_stored(segment.config)
        levels = PublishedRack.read_from_segment(segment).levels
        self._levels = {name: published for name, published in levels.items() if published.commands}

    def list_levels(self) -> list[dict[str, str]]:
        """Return plain data about each level: the commands it takes, and its command in force."""
        return [
            {
                "level": name,
                "in_force": self._name_command_in_force(name),
                "takes": describe_commands(level),
            }
            for name, level in self._levels.items()
        ]

    def format_levels(self) -> Iterator[str]:
        """Yield the lines of a table with the data of `list_levels`."""
        return format_fitted_table(
            ["level", "in force", "takes"], [list(row.values()) for row in self.list_levels()]
        )

    def list_highest_levels(self, *in_force: str) -> list[str]:
        """List the highest levels that can hold and whose command in force is one of `in_force`.

        Levels below another level of the result are left out.

        Args:
            in_force: Names of operator commands. "" stands for no command.
        """
        levels = [
            name
            for name in self._levels
            if self._can_hold(name) and self._name_command_in_force(name) in in_force
        ]
        lower_levels = set[str]().union(*map(self._config.find_boards_below, levels))
        return [name for name in levels if name not in lower_levels]

    def give_command(
        self, given: Mapping[str, Any], wait: bool, timeout_s: float | None = None
    ) -> Reply:
        """Give a command, and wait until its level has accepted it or, with `wait`, completed it.

        Args:
            given: Keys of a `[[command]]` table.
            wait: True to wait until the command is done.
            timeout_s: Maximum wall-clock time to wait. None to wait until the end of the run.

        Raises:
            ConfigError: The command has mistakes, which are all listed.
            Failure: The command was not given, or not answered in time.
        """
        segment = self._segment
        command, clock_request = self._build_request(given)
        if wait_text := describe_wait(segment):
            # Leave the request in the table for the next step, even after this process has ended.
            entry = OperatorTable(segment).add_request(clock_request)
            text = describe_command(copy_request_message(entry, segment.layout))
            return Reply(0, command.level, text, -1, "waiting", waits=wait_text)
        # On any exit from the context, a request that has not been given is withdrawn.
        with OperatorTable(segment).claim_request(clock_request) as entry:
            reply = self._await_given(entry, command.level)
        if command.operation is Operation.SCHEDULE:
            return self._check_scheduler(reply, command.name or "")
        if command.operation is Operation.SWITCH:
            return self._check_hand_over(reply)
        return self._await_reply(reply, wait, timeout_s)

    def lease_command(self, given: Mapping[str, Any], tell: Callable[[Reply], None]) -> None:
        """Give a command, and keep it leased until a newer one is in force or the run is over.

        If this process ends or hangs before that, the level holds.

        Args:
            given: As in `give_command`.
            tell: Called with the reply of the level.

        Raises:
            Failure: As in `give_command`, and for a command that does not stay in force.
        """
        command, clock_request = self._build_request(given)
        segment = self._segment
        if command.operation not in EFFECTS or not self._can_hold(command.level):
            lasting = ", ".join(operation.name.lower() for operation in EFFECTS)
            why = f"must be one of {lasting}, to a level that can hold"
            raise Failure(f"--lease: '{command.level}', {command.what}: {why}", 2)
        if wait_text := describe_wait(segment):
            raise Failure(f"--lease: the rack is held: {wait_text}")
        table = OperatorTable(segment)
        with table.claim_request(clock_request, Client.LEASES) as entry:
            ticket = entry.ticket
            reply = self._await_reply(self._await_given(entry, command.level), False, None)
            tell(reply)
            while (
                reply.worked and table.record_heartbeat(entry, ticket) and not segment.run_is_over
            ):
                time.sleep(CHECK_INTERVAL_S)

    def _can_hold(self, level: str) -> bool:
        """Return whether a level takes the command `hold`."""
        return Operation.HOLD in (self._levels[level].commands)

    def _build_request(self, fields: Mapping[str, Any]) -> tuple[CommandConfig, Request]:
        """Build a command and its request to the clock. Raises the errors of `give_command`."""
        tick = self._segment.tick
        command = parse_command({key: value for key, value in fields.items() if value is not None})
        wanted = build_request(command, self._config, self._levels, self._segment.layout)
        if 0 <= wanted.tick <= tick:
            key, value = ("tick", command.tick) if command.at is None else ("at", command.at)
            raise ConfigError([Mistake(key, value, f"has passed; the rack is at tick {tick}")])
        if self._segment.run_is_over:
            raise Failure(f"rack '{self._segment.rack}': its run is over")
        return command, wanted

    def set_param(self, setting: str, tick: int | None = None, at: float | None = None) -> Reply:
        """Set a live parameter.

        Args:
            setting: KEY=VALUE, as in `board.servo.params.bandwidth=80`.
            tick: Tick of the command. None for the next one.
            at: Simulated time of the command in s, in place of `tick`.

        Returns:
            The reply of the level.

        Raises:
            Failure: The parameter is not live, or as in `give_command`.
        """
        place, _, _ = setting.partition("=")[0].rpartition(".")
        live = {
            name: published.live_keys
            for name, published in self._levels.items()
            if Operation.SET in published.commands
        }
        level = next((level for level in live if place == f"board.{level}.params"), None)
        if level is None:
            known = [f"board.{board}.params.{key}" for board, keys in live.items() for key in keys]
            raise Failure(
                f"{setting}: not a live parameter; valid keys: {', '.join(known) or 'none'}", 2
            )
        name = setting.removeprefix(f"{place}.")
        fields = {"level": level, "what": "set", "name": name, "tick": tick, "at": at}
        return self.give_command(fields, wait=False)

    def _await_given(self, entry: RequestEntry, level: str) -> Reply:
        """Wait until the clock has given a command to its level. Raises `Failure`."""
        ticket = entry.ticket
        text = describe_command(copy_request_message(entry, self._segment.layout))
        about = f"'{level}', {text}"
        for is_over in self._poll_run(about, f"waiting for tick {max(0, entry.tick)}"):
            if entry.ticket != ticket:
                break
            if entry.stage == RequestStage.GIVEN:
                return Reply(entry.serial, level, text, entry.given_tick)
            if is_over:
                raise Failure(f"{about}: the run ended before the command was given")
        raise Failure(f"{about}: given, but the reply is lost because too many commands followed")

    def _await_reply(self, reply: Reply, wait: bool, timeout_s: float | None) -> Reply:
        """Wait until the level has accepted the command or, with `wait`, completed it."""
        deadline = math.inf if timeout_s is None else time.monotonic() + timeout_s
        status = find_answering_status(self._segment, reply.level)
        if status is None:
            return reply
        replies = ReplyReader(self._segment, status, reply)
        last = ReplyDeadline(self._segment, status)
        about = f"command {reply.serial}"
        awaited = f"waiting for '{reply.level}', which runs every {status.every} ticks"
        for is_over in self._poll_run(about, awaited):
            late = last.explain_missing_reply(self._segment.tick)
            reply = replies.read_statuses()
            if reply.fate not in ("given", "taken") or (reply.fate == "taken" and not wait):
                break
            if is_over:
                raise Failure(f"{reply.line}; the run ended")
            if reply.fate == "given" and late:
                raise Failure(f"{about}: '{reply.level}' {late}")
            if time.monotonic() > deadline:
                still = f"in force until: {format_resume_command(self._segment.rack, reply.level)}"
                raise Failure(f"timed out after {timeout_s:g} s: {reply.line}, not done; {still}")
        return reply

    def _check_scheduler(self, reply: Reply, word: str) -> Reply:
        """Return the reply of the clock, which has changed the scheduler of a board or not."""
        now = Scheduler(self._segment.get_block(reply.level)[Block.SCHEDULER]).word
        reply = replace(reply, fate="done", taken_up=reply.given, done=reply.given)
        if now == word:
            return reply
        return replace(
            reply, fate="refused", objection=f"still {now}; see the event for the reason"
        )

    def _check_hand_over(self, reply: Reply) -> Reply:
        """Wait until a standby has taken over, and return the reply of the clock."""
        words = self._segment.get_block(reply.level)
        for is_over in self._poll_run(reply.line, "the standby"):
            since = words[Block.ACTIVE_SINCE]
            if words[Block.HAND_OVERS] and since >= reply.given:
                return replace(reply, fate="done", taken_up=since, done=since)
            if is_over or not words[Block.TAKE_OVER]:
                break
        why = "no standby has the state of the active copy; see `rack status`"
        return replace(reply, fate="refused", taken_up=reply.given, objection=why)

    def _poll_run(self, about: str, awaited: str) -> Iterator[bool]:
        """Check the rack repeatedly, and yield each time whether the run is over.

        After `EXPLAIN_AFTER_S` it prints once on stderr what is awaited. Raises `Failure` if the
        clock stops ticking although the rack is not held.
        """
        words = self._segment.words
        tick = words[System.TICK]
        changed = time.monotonic()
        note_at = changed + EXPLAIN_AFTER_S
        while True:
            # The caller reads statuses after this, so that a last reply before the end counts.
            yield self._segment.run_is_over
            time.sleep(CHECK_INTERVAL_S)
            now = time.monotonic()
            if tick != words[System.TICK] or words[System.HELD]:
                tick = words[System.TICK]
                changed = now
            if now > note_at:
                note_at = math.inf
                print(
                    f"{about}: {awaited}; the rack is at tick {tick}", file=sys.stderr, flush=True
                )
            if now - changed >= MAX_SILENCE_S:
                raise Failure(
                    f"{about}: no answer: the clock has not ticked for {MAX_SILENCE_S:g} s"
                )

    def _name_command_in_force(self, level: str) -> str:
        """Return the name of the operator's command in force at a level. Empty for none."""
        status = NewestMessages(self._segment).read_message(f"{level}.status")
        standing = getattr(status, "standing", 0)
        return Operation(standing).name.lower() if standing else ""


def parse_goal(what: str, words: Sequence[str]) -> Document:
    """Convert the words after the verb of a command to keys of a `[[command]]` table.

    Args:
        what: The verb.
        words: `home`, key=numbers, NAME on|off, or the name of a table or command.

    Raises:
        Failure: A word is not valid.
    """
    if what == "modify":
        if len(words) != 2 or words[1] not in ("on", "off"):
            raise Failure(
                f"'modify {' '.join(words)}': must be 'modify NAME on' or 'modify NAME off'", 2
            )
        return {"name": words[0], "on": words[1] == "on"}
    if what in ("table", "do", "set", "schedule"):
        return {"name": " ".join(words)}
    goal: Document = {}
    for word in words:
        key, is_given, values = word.partition("=")
        if key in goal:
            raise Failure(f"'{word}': {key} is given twice", 2)
        if word == "home":
            goal["home"] = True
        elif not is_given or key not in GOAL_KEYS:
            keys = ", ".join(f"{k}=..." for k in GOAL_KEYS)
            raise Failure(f"'{word}': not a goal; valid goals: home, {keys}", 2)
        else:
            goal[key] = [_parse_number(value, word) for value in values.split(",")]
    return goal


def _parse_number(text: str, word: str) -> float:
    """Parse a number of a goal. Raises `Failure` with `word`, which contains the number."""
    try:
        return float(text)
    except ValueError:
        why = f"'{text}' is not a number; numbers are separated by commas, as in joints=0,0.5,1"
        raise Failure(f"'{word}': {why}", 2) from None
