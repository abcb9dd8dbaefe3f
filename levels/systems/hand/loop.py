"""What all loops of a hand have in common: whom they follow, when they keep what they have, and
what they report."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from rack.backplane.message import Message, State
from rack.levels.algebra import Mask
from rack.levels.level import Executor, LevelContext, Misfits, Ports, Reading
from rack.levels.operator import BELOW_LOST, HOLDABLE, Orders
from rack.levels.robot.cell import cell_of
from rack.levels.robot.hand import Hand

NO_HAND_YET = "no status of the hand yet: waiting for its board"
HAND_LOST = "no status of the hand: what was commanded last is kept"


class HandLoop(Executor):
    """A loop between the level above and the hand: follows the newest command, at the state that
    the hand has sensed.

    Without a fresh command it keeps what was commanded last, at rest: what the hand holds, it goes
    on holding. So it does on an operator's hold. A command that is not finite is not taken. A
    subclass has the ports "command", "hand", "operator" and, unless the hand is below it, "below".
    """

    commands = HOLDABLE

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.cell = cell_of(context)
        assert self.cell.hand is not None, "`misfits` refuses a robot without a hand"
        self.hand: Hand = self.cell.hand
        self.orders = Orders(self.commands)
        command = self.inputs["command"].type
        self.command = Message(command.dtype(context.sizes))  # that is followed
        # Names of its fields that must be finite.
        self._numbers = [field.name for field in command.fields if field.kind == "f8"]
        self.commanded = False  # there was one
        # (joints,) or (fingers,), as in the status: those of this board.
        self.driven: Mask
        self._above = ", ".join(context.above)
        self._period = max(pace.every for pace in context.above.values())
        slowest = max(context.every, *(pace.every for pace in context.below.values()))
        # Ticks, of a status of the hand.
        self._oldest = slowest + self.cell.patience.ticks(slowest, context.tick_s)
        self._taken = 0  # tick at which `command` came
        self._rejected = ""  # why the newest command is not followed
        self._held = False  # by an operator, in the last cycle
        self._met = False  # a status of the hand has come
        self._shown: tuple[Any, ...] = ()  # in the last status

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
        """Yield a robot that has no hand, and a lack of neighbours."""
        if context.robot.hand is None:
            yield "executor", cls.__name__, "it drives a hand; there is no [robot.hand]"
        for place, boards in (("above", above), ("below", below)):
            if not boards:
                yield place, [], "it needs a board there"

    @abstractmethod
    def meet(self, read: Ports, hand: Message) -> None:
        """Begin with the first `HAND_STATUS`, or continue from the level's own last messages."""

    @abstractmethod
    def follow(self, hand: Message, write: Ports, tick: int) -> None:
        """Write the level's command for `self.command`, and what its status says of fingers or
        joints."""

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Follow the newest command, and report."""
        hand: Reading = read.hand
        self.orders.take(read.operator)
        if not self._met:
            if not hand.is_there:
                status = write.status
                status.driven = self.driven
                status.sensed = -1
                status.holding = True
                status.stopped = True
                status.reason = NO_HAND_YET
                return
            self._met = True
            self.meet(read, hand.value)
        self._take(read.command, tick)
        kept = self._kept(read, tick)
        self.follow(hand.value, write, tick)
        write.command.id += 1
        write.command.operator = self.orders.rests_on(self.command.operator)
        self._report(read, write.status, kept)
        self.orders.report(write.status, self.command.operator)

    def age_s(self, hand: Message, tick: int) -> float:
        """Return how old the sample of a `HAND_STATUS` is when what this cycle commands acts, s."""
        return float(
            (min(tick - hand.tick, self._oldest) + self.context.every) * self.context.tick_s
        )

    def ahead_s(self, tick: int) -> float:
        """Return the time by which the command is to be taken on at its velocities, s: a cycle of
        the level above."""
        return min(tick - self._taken, self._period) * self.context.tick_s

    def _take(self, command: Reading, tick: int) -> None:
        """Follow what is new, unless an operator holds the loop."""
        released = self._held
        self._held = self.orders.holds
        if self._held:
            for name in self._numbers:
                if name.endswith("velocity"):  # what is commanded is kept at rest
                    setattr(self.command, name, 0.0)
            self.orders.done()
        elif command.is_new or (released and command.is_there):
            wrong = [
                name
                for name in self._numbers
                if not np.isfinite(getattr(command.value, name)).all()
            ]
            self._rejected = (
                f"rejected: {wrong[0]} commanded by '{self._above}' is not finite" if wrong else ""
            )
            if not wrong:
                self.command.copy_from(command.value)
                self.commanded = True
                self._taken = tick

    def _kept(self, read: Ports, tick: int) -> str:
        """Return why the hand does not follow the level above; empty: it does."""
        hand = read.hand.value
        if read.hand.is_lost or tick - hand.tick > self._oldest:
            return HAND_LOST
        if hand.stopped:
            return f"hand: {hand.reason}"
        if "below" in self.inputs:
            below = read.below
            if below.is_lost or not below.is_there:
                return BELOW_LOST
            if below.value.stopped:
                return str(below.value.reason)
        return self.orders.keeps(self.context.board)

    def _report(self, read: Ports, status: Message, kept: str) -> None:
        """Fill the status; its steady fields when they change."""
        hand = read.hand.value
        lost = self.commanded and read.command.is_lost
        status.sensed = hand.tick
        status.echo = self.command.id
        note = kept or self._rejected
        if lost and not note:
            note = f"no command from '{self._above}': its last one is kept"
        shown = bool(kept), lost or not self.commanded, note, hand.error
        if shown == self._shown:
            return
        self._shown = shown
        status.driven = self.driven
        status.stopped, status.holding, status.reason, status.error = shown
        if hand.error:
            status.state = State.ERROR
        elif note and self.commanded:
            status.state = State.HOLDING
        else:
            status.state = State.EXECUTING if self.commanded else State.IDLE
