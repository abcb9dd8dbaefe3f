"""One copy of a task with standbys: holds its messages back, compares them, and takes over.

All copies cycle alike. The active copy writes. In every other copy `Replica.begin_cycle` compares
the messages that the copy held back in its last cycle with those that the active copy has written
in that cycle. If any differ, or the active copy has missed the cycle, the copy continues from the
active copy's message on port `state` (`Executor.realign`), until all messages are equal again.

The clock requests a hand-over once the active copy is lost (`rack.boards.run.hand_over`). In
lockstep the standby then also publishes the messages of its last cycle that the lost copy has not
published, so readers miss none. In real time a standby also takes over by itself if the active copy
has not finished its last cycle. The messages of that cycle would be late, so readers miss one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from rack.backplane.address_map import SLOT_HEAD_SIZE
from rack.backplane.byte_lock import ByteLock
from rack.backplane.checked import to_enum
from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.mailbox import Writer
from rack.backplane.mailbox.protocols import open_standby_writer
from rack.backplane.mailbox.slots import Slots
from rack.backplane.process import ENDED_STATES, STOPPED_STATES, read_state
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, Box, HandOver, Run, Slot, System
from rack.boards.run.control_loop import VirtualControlLoop
from rack.boards.run.ports import OutputPort, OutputPorts
from rack.boards.wiring import TaskWiring
from rack.levels.level import Executor

if TYPE_CHECKING:
    from rack.boards.run.vote import Ballot

VOTE = "rack.boards.run.vote"
STATE_PORT = "state"
"""Output with the state from which a standby continues."""
MAX_AHEAD = 3
"""Largest number of messages that the active copy may have written since the compared cycle."""


class FieldDifference(NamedTuple):
    """First field in which a message of a copy differs from that of the active copy."""

    mailbox: str
    field: str


class ReplicatedOutputs(OutputPorts):
    """Outputs of a copy. It writes them while it is active, and holds them back otherwise."""

    replica: Replica

    def open_writer(self, segment: Segment, name: str) -> Writer:
        """Open a mailbox without claiming it."""
        return open_standby_writer(segment, name)

    def write(self, tick: int, now: int | None) -> bool:
        """Write the messages of a cycle, or hold them back. See `OutputPorts.write`."""
        return not self.replica.may_write(tick) or super().write(tick, now)

    def publish_held(self, tick: int, now: int | None) -> None:
        """Publish the messages of the cycle released at `tick` that no copy has published yet.

        Args:
            tick: Release tick of the last cycle.
            now: Current tick. None if the messages are known to be in time.
        """
        for port in self.ports:
            slots = port.writer.slots
            head = slots.box[Box.HEAD]
            is_published = slots.has_message(head) and (
                slots.heads[head & slots.mask][Slot.TICK] >= tick
            )
            if not is_published and (now is None or now < tick + port.writer.spec.delay):
                port.write(tick, now)


class PublishedOutput:
    """Read access to the messages that the active copy has written to one mailbox.

    Attributes:
        writer: Writer of this copy.
        slots: Slots of the mailbox.
        held: Message that this copy has held back in its last cycle.
    """

    def __init__(self, segment: Segment, port: OutputPort) -> None:
        self.writer = port.writer
        self._port = port
        self._spec: MailboxSpec = port.writer.spec
        self.slots = Slots(segment, self._spec)
        self.held: bytes | memoryview = self.writer.message.raw

    def is_due(self, tick: int) -> bool:
        """Return True if the cycle released at `tick` writes this mailbox."""
        spec = self._spec
        return (tick + spec.lead_ticks - spec.phase) % spec.every == 0

    def hold_message(self, tick: int) -> None:
        """Hold back the message of the cycle released at `tick`."""
        if self.is_due(tick):
            self.held = self._port.find_content(tick)

    def fetch_message(self, tick: int) -> bool:
        """Copy the message of the cycle released at `tick`. Return False if there is none."""
        slots = self.slots
        head = slots.box[Box.HEAD]
        for serial in range(head, max(0, head - MAX_AHEAD), -1):
            if slots.heads[serial & slots.mask][Slot.TICK] == tick:
                return slots.fetch_message(serial) and slots.is_from_claimant(0)
        return False

    def find_difference(self) -> str:
        """Return the first field in which the copied message differs. Empty if none does."""
        theirs = self.slots.record[SLOT_HEAD_SIZE:]
        ours = self.held
        if theirs == ours:
            return ""
        fields = self._spec.fields
        ends = (*(field.offset for field in fields[1:]), self._spec.size)
        for field, end in zip(fields, ends, strict=True):
            if theirs[field.offset : end] != ours[field.offset : end]:
                return field.name
        return fields[-1].name


class Replica:
    """The part of one process in a task with standbys.

    Attributes:
        number: Number of this copy, 0 for the task itself.
        held_tick: Release tick of the last cycle whose messages were held back, -1 for none.
    """

    def __init__(
        self,
        segment: Segment,
        wiring: TaskWiring,
        outputs: ReplicatedOutputs,
        level: Executor,
        alarms: AlarmWriter,
    ) -> None:
        spec = segment.layout.find_task(wiring.task)
        copies = segment.layout.list_copies(spec.board)
        self.number = copies.index(spec)
        self.held_tick = -1
        self._late = self._quiet_until = -1
        # Copies that begin with the run are equal from their first cycle on.
        self._is_first = segment.words[System.STATE] == Run.STARTING
        self._alarms = alarms
        self._index = segment.layout.processes.index(spec)
        self._words = segment.words
        self._every = spec.every
        self._level = level
        self._outputs = outputs
        self._writers: Sequence[Writer] = tuple(outputs.writers.values())
        self._group = segment.get_block(spec.board)
        self._block = segment.get_block(spec.name)
        self._blocks = segment.get_copy_blocks(spec.board)
        self._lock = ByteLock(segment.fd, segment.map.blocks[spec.board] + 8 * Block.ACTIVE)
        self._is_lockstep = bool(segment.words[System.LOCKSTEP])
        self._published: Mapping[str, PublishedOutput] = {
            name: PublishedOutput(segment, port)
            for name, port in zip(outputs.writers, outputs.ports, strict=True)
        }
        self._block[Block.ALIGNED] = 0
        self._ballot: Ballot | None = None
        if wiring.votes:
            # Import it only in racks that vote.
            self._ballot = import_module(VOTE).Ballot(self._blocks, self.number, spec.every)
        outputs.replica = self
        if self.number == 0 and segment.words[System.STATE] == Run.STARTING:
            self._claim_mailboxes()

    @property
    def is_active(self) -> bool:
        """True if this copy writes the mailboxes."""
        return bool(self._group[Block.ACTIVE] == self.number)

    def begin_cycle(self, tick: int, is_late: bool) -> FieldDifference | None:
        """Do what is due before the cycle released at `tick` reads its inputs.

        Args:
            tick: Release tick of the cycle.
            is_late: True if this copy has missed a deadline, or was released late.

        Returns:
            The first difference to the active copy in the last cycle, if there was none in the
            cycle before.
        """
        self.serve_request()
        if self.is_active:
            self._keep_claims(tick)
            return None
        if self._writers and self._writers[0].has_claim:
            # Another copy has taken over while this one was late or stopped.
            for writer in self._writers:
                writer.release_claim()
        held = self.held_tick
        if held < 0 or held != tick - self._every:
            self._block[Block.ALIGNED] = 0
            self._realign_level(tick - self._every)
            return None
        if not self._is_lockstep and (reason := self._find_loss(held, is_late)):
            self.take_over(tick, reason)
            return None
        late = sum(block[Block.MISSED] + block[Block.SKIPPED] for block in self._blocks)
        if late != self._late:
            # A level may act differently in the cycle after a late one.
            self._quiet_until = tick + 2 * self._every if self._late >= 0 else -1
            self._late = late
        difference = self._compare_messages(held)
        return None if tick <= self._quiet_until else difference

    def may_write(self, tick: int) -> bool:
        """Return True if this copy is active. Otherwise hold back the messages of the cycle."""
        if self.is_active and all(writer.holds_claim for writer in self._writers):
            return True
        self.held_tick = tick
        for output in self._published.values():
            output.hold_message(tick)
        if self._ballot is not None:
            due = self._list_due(tick)
            self._ballot.cast_vote(tick, (output.held for output in due))
        return False

    def serve_request(self) -> bool:
        """Take over if the clock requests it from this copy. Return True if this was done."""
        group = self._group
        if group[Block.TAKE_OVER] != self.number + 1:
            return False
        tick = self._words[System.TICK]
        reason = to_enum(HandOver, group[Block.TAKE_OVER_REASON])
        if not self.is_active and not self.take_over(tick, reason):
            return False
        group[Block.TAKE_OVER] = 0
        if self.held_tick >= 0:
            self._outputs.publish_held(self.held_tick, None if self._is_lockstep else tick)
        return True

    def take_over(self, tick: int, reason: HandOver) -> bool:
        """Claim the mailboxes, and become the active copy.

        Args:
            tick: Tick from which this copy writes.
            reason: Reason for the hand-over.

        Returns:
            False if another copy is taking over, or has been killed or stopped in doing so. Then
            try again in the next cycle.
        """
        group = self._group
        active = group[Block.ACTIVE]
        if not self._lock.take():
            return False
        try:
            if group[Block.ACTIVE] == active:
                self._claim_mailboxes()
                if active != self.number:
                    group[Block.ACTIVE_SINCE] = tick
                    group[Block.HAND_OVER] = reason
                    group[Block.HAND_OVERS] += 1
                    self._alarms.raise_alarm(tick, Alarm.TAKEN_OVER, self._index, reason)
                self._block[Block.ALIGNED] = 0
                # From here on the other copies hold their messages back.
                group[Block.ACTIVE] = self.number
        finally:
            self._lock.release()
        return self.is_active

    def _claim_mailboxes(self) -> None:
        """Claim all mailboxes of the task, in new epochs."""
        for writer in self._writers:
            writer.take_over()

    def _keep_claims(self, tick: int) -> None:
        """Claim the mailboxes if this is a new process or a standby has died while taking over."""
        if all(writer.holds_claim for writer in self._writers):
            for writer in self._writers:
                writer.is_locked or writer.try_lock()
        elif not self._group[Block.TAKE_OVER]:
            # Otherwise the clock has asked another copy to take over from an earlier process.
            self.take_over(tick, HandOver.LOST)

    def _find_loss(self, held: int, is_late: bool) -> HandOver:
        """Return why the active copy must be replaced, or NONE. Called in real time.

        Args:
            held: Release tick of the last cycle, which this copy has finished.
            is_late: True if this copy is late itself.
        """
        active = self._blocks[self._group[Block.ACTIVE]]
        if active[Block.DONE] >= held and not active[Block.LOST]:
            return HandOver.NONE
        state = read_state(active[Block.PID])
        if active[Block.LOST] or state in ENDED_STATES:
            return HandOver.LOST
        if state in STOPPED_STATES:
            return HandOver.STOPPED
        # A copy that was late itself, or that does not have the state of the active one, is no
        # better than a copy that is merely late.
        is_worse = is_late or not self._block[Block.ALIGNED]
        return HandOver.NONE if is_worse else HandOver.LATE

    def _compare_messages(self, held: int) -> FieldDifference | None:
        """Compare the messages held back in a cycle with those of the active copy.

        Args:
            held: Release tick of that cycle.

        Returns:
            The first difference, if there was none in the cycle before.
        """
        was_aligned = self._block[Block.ALIGNED] or self._is_first
        self._is_first = False
        difference = None
        is_complete = True
        for output in self._list_due(held):
            if not output.fetch_message(held):
                is_complete = False
            elif difference is None and (field := output.find_difference()):
                difference = FieldDifference(output.writer.spec.name, field)
        if is_complete and difference is None:
            self._block[Block.ALIGNED] = self._block[Block.ALIGNED] or held + 1
            return None
        self._block[Block.ALIGNED] = 0
        if self._ballot is not None and is_complete:
            # The messages of the active copy were fetched above.
            theirs = (o.slots.record[SLOT_HEAD_SIZE:] for o in self._list_due(held))
            active = self._group[Block.ACTIVE]
            stray = self._ballot.find_stray(held, active, theirs)
            if stray is not None and was_aligned:
                self._group[Block.STRAYED] = stray + 1
            if stray == active:
                # The state of that copy is of no use.
                return difference if was_aligned else None
        self._realign_level(held)
        return difference if was_aligned and is_complete else None

    def _list_due(self, tick: int) -> Iterator[PublishedOutput]:
        """Yield the outputs that the cycle released at `tick` writes."""
        return (output for output in self._published.values() if output.is_due(tick))

    def _realign_level(self, tick: int) -> None:
        """Let the level continue from the state that the active copy has written at `tick`."""
        state = self._published.get(STATE_PORT)
        if state is not None and state.fetch_message(tick):
            self._level.realign(state.slots.message)


class ReplicatedLoop(VirtualControlLoop):
    """The cycles of a copy of a task with standbys.

    Findings of the level and actions of faults are reported by the active copy alone.
    """

    outputs_class = ReplicatedOutputs
    outputs: ReplicatedOutputs

    def __init__(
        self, segment: Segment, wiring: TaskWiring, executor: Executor, attention: int | None = None
    ) -> None:
        super().__init__(segment, wiring, executor, attention)
        self.replica = Replica(segment, wiring, self.outputs, executor, self.alarms)
        self.next_cycle.serve_request = self.serve_request
        self._compares = wiring.compares
        self._boxes = [box.name for box in segment.layout.mailboxes]

    def serve_request(self) -> None:
        """Take over between two cycles if the clock requests it."""
        if self.replica.serve_request():
            self.stopwatch.notify_clock()

    def cycle(self, tick: int) -> None:
        """Run the cycle released at `tick`."""
        is_late = self.stopwatch.has_missed or self.next_cycle.skipped > 0
        difference = self.replica.begin_cycle(tick, is_late)
        if difference is not None and self._compares:
            subject = self._boxes.index(difference.mailbox)
            self.alarms.raise_alarm(tick, Alarm.DIFFERS, subject, text=difference.field)
        super().cycle(tick)

    def _report_findings(self, tick: int) -> None:
        """Report findings if this copy is active. Otherwise drop them."""
        if not self.replica.is_active:
            self.executor.findings.clear()
            self.executor.acted.clear()
        super()._report_findings(tick)
