"""One copy of a task with standbys: holds its messages back, compares them, and takes over.

All copies cycle alike, and the active copy writes. Before each cycle, every other copy compares the
messages of its last cycle, which it has held back, with the messages of the active copy. If any
differ, or the active copy has missed the cycle, the copy continues from the active copy's message
on port `state` (`Executor.realign`), until all messages are equal again.

The clock requests a hand-over once the active copy is lost (`rack.boards.run.hand_over`). In
lockstep the standby then also publishes the messages of its last cycle that the lost copy has not
published, so readers miss none. In real time a standby also takes over by itself if the active copy
has not finished its last cycle. The messages of that cycle would be late, so readers miss one.

With three copies, each standby stores a checksum of the messages that it holds back, its vote. A
standby that finds a difference compares votes. If the third copy agrees with it, the active copy
has strayed. If the third copy agrees with the active one, it has strayed itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from xxhash import xxh3_64_intdigest

from rack.backplane.address_map import SLOT_HEAD_SIZE
from rack.backplane.checked import to_enum
from rack.backplane.mailbox.protocols import open_standby_writer
from rack.backplane.mailbox.slots import Slots
from rack.backplane.process import STOPPED_STATES, is_ending, read_state
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Block, Box, HandOver, Run, Slot, System
from rack.boards.run.control_loop import VirtualControlLoop
from rack.boards.run.ports import OutputPort, OutputPorts
from rack.boards.run.writing_right import WritingRight
from rack.boards.wiring import TaskWiring
from rack.levels.level import Executor

STATE_SUFFIX = ".state"
"""End of the name of a mailbox that contains the state of a level for its standbys."""
MAX_AHEAD = 3
"""Largest number of messages that the active copy may have written since the compared cycle."""


class ReplicatedOutputs(OutputPorts):
    """Outputs of a copy, which claims its mailboxes when it takes over."""

    open_writer = staticmethod(open_standby_writer)


class ReplicatedOutput:
    """One output of a copy: its own message, and the message of the active copy.

    Attributes:
        spec: The mailbox.
        slots: Slots of the mailbox.
        held: Message of the last cycle, which this copy has held back.
    """

    def __init__(self, segment: Segment, port: OutputPort) -> None:
        self._port = port
        self.spec = port.writer.spec
        self.slots = Slots(segment, self.spec)
        self.held: bytes | memoryview = port.writer.message.raw

    def hold_message(self, tick: int) -> None:
        """Hold back the message of the cycle released at `tick`."""
        self.held = self._port.find_content(tick)

    def fetch_message(self, tick: int) -> bool:
        """Copy the active copy's message of the cycle released at `tick`. False if it has none."""
        slots = self.slots
        head = slots.box[Box.HEAD]
        for serial in range(head, max(0, head - MAX_AHEAD), -1):
            if slots.heads[serial & slots.mask][Slot.TICK] == tick:
                return slots.fetch_message(serial) and slots.is_from_claimant(0)
        return False

    @property
    def published(self) -> memoryview:
        """The fetched message."""
        return self.slots.record[SLOT_HEAD_SIZE:]

    def find_difference(self) -> str:
        """Return the name of the first field whose value in the fetched message is another one."""
        fields = self.spec.fields
        ends = (*(field.offset for field in fields[1:]), self.spec.size)
        return next(
            field.name
            for field, end in zip(fields, ends, strict=True)
            if self.held[field.offset : end] != self.published[field.offset : end]
        )

    def publish_held(self, tick: int, now: int | None) -> None:
        """Publish the message of the cycle released at `tick` unless a copy has published it.

        Args:
            tick: Release tick of the last cycle.
            now: Current tick. None if the message is known to be in time.
        """
        slots = self.slots
        head = slots.box[Box.HEAD]
        is_published = slots.has_message(head) and (
            slots.heads[head & slots.mask][Slot.TICK] >= tick
        )
        if not is_published and (now is None or now < tick + self.spec.delay):
            self._port.write(tick, now)


class ReplicatedLoop(VirtualControlLoop):
    """The cycles of a copy of a task with standbys.

    Findings of the level and actions of faults are reported by the active copy alone.
    """

    outputs_class = ReplicatedOutputs

    def __init__(
        self, segment: Segment, wiring: TaskWiring, executor: Executor, attention: int | None
    ) -> None:
        super().__init__(segment, wiring, executor, attention)
        self._layout = segment.layout
        self._compares = wiring.compares
        self._votes = wiring.votes
        writers = self.outputs.writers.values()
        self.right = WritingRight(segment, self.spec, writers, self.alarms)
        self._group = self.right.group
        copies = segment.layout.list_copies(self.spec.board)
        self._blocks = [segment.get_block(copy.name) for copy in copies]
        self._outputs = [ReplicatedOutput(segment, port) for port in self.outputs.ports]
        self._held_tick: int | None = None  # last cycle whose messages were held back
        self._late = self._quiet_until = -1
        # Copies that begin with the run are equal from their first cycle on.
        self._is_first = self.words[System.STATE] == Run.STARTING
        self._write = self.write_command_and_status
        self.write_command_and_status = self._write_or_hold
        self.next_cycle.serve_request = self.serve_request
        self.block[Block.ALIGNED] = 0
        if self._is_first and self.right.number == 0:
            self.right.take_over(0, HandOver.NONE)

    def serve_request(self) -> None:
        """Take over if the clock requests it from this copy. Called between two cycles."""
        group = self._group
        if group[Block.TAKE_OVER] != self.right.number + 1:
            return
        if not self.right.is_held:
            tick = self.words[System.TICK]
            if not self.right.take_over(tick, to_enum(HandOver, group[Block.TAKE_OVER_REASON])):
                return
            if self._held_tick is not None:
                now = None if self.clock.is_lockstep else tick
                for output in self._outputs:
                    output.publish_held(self._held_tick, now)
        group[Block.TAKE_OVER] = 0
        self.stopwatch.notify_clock()

    def cycle(self, tick: int) -> None:
        """Run the cycle released at `tick`."""
        self.serve_request()
        if self.right.is_held:
            self.right.keep_claims(tick)
        else:
            self._follow_active_copy(tick)
        super().cycle(tick)

    def _follow_active_copy(self, tick: int) -> None:
        """Compare this copy with the active one before a cycle, and realign it if necessary.

        In real time, take over instead if the active copy is lost or late.
        """
        self.right.release_claims()
        held = tick - self.spec.every
        if self._held_tick != held:
            self.block[Block.ALIGNED] = 0
            self._realign_level(held)
            return
        if not self.clock.is_lockstep and (reason := self._find_loss(held)):
            self.right.take_over(tick, reason)
            return
        late = sum(block[Block.MISSED] + block[Block.SKIPPED] for block in self._blocks)
        if late != self._late:
            # A level may act differently in the cycle after a late one.
            self._quiet_until = tick + 2 * self.spec.every if self._late >= 0 else -1
            self._late = late
        self._compare_messages(tick, held)

    def _find_loss(self, held: int) -> HandOver:
        """Return why the active copy must be replaced, or NONE. Called in real time.

        Args:
            held: Release tick of the last cycle, which this copy has finished.
        """
        active = self._blocks[self._group[Block.ACTIVE]]
        if active[Block.DONE] >= held and not active[Block.LOST]:
            return HandOver.NONE
        pid = active[Block.PID]
        if active[Block.LOST] or is_ending(pid):
            return HandOver.LOST
        if read_state(pid) in STOPPED_STATES:
            return HandOver.STOPPED
        # A copy that was late itself, or that does not have the state of the active one, is no
        # better than a copy that is merely late.
        is_late = self.stopwatch.has_missed or self.next_cycle.skipped > 0
        return HandOver.NONE if is_late or not self.block[Block.ALIGNED] else HandOver.LATE

    def _compare_messages(self, tick: int, held: int) -> None:
        """Compare the messages of the last cycle with the messages of the active copy.

        Args:
            tick: Release tick of this cycle.
            held: Release tick of the last one.
        """
        block = self.block
        was_aligned = block[Block.ALIGNED] or self._is_first
        self._is_first = False
        due = self._list_due(held)
        if all(output.fetch_message(held) for output in due):
            differing = next((output for output in due if output.published != output.held), None)
            if differing is None:
                block[Block.ALIGNED] = block[Block.ALIGNED] or held + 1
                return
            if was_aligned and self._compares and tick > self._quiet_until:
                self.alarms.raise_alarm(
                    tick,
                    Alarm.DIFFERS,
                    self._layout.mailboxes.index(differing.spec),
                    text=differing.find_difference(),
                )
            stray = self._find_stray(held, due) if self._votes else None
            if stray is not None and was_aligned:
                self._group[Block.STRAYED] = stray + 1
        else:
            stray = None
        block[Block.ALIGNED] = 0
        if stray != self._group[Block.ACTIVE]:
            # Otherwise the state of the active copy is of no use.
            self._realign_level(held)

    def _find_stray(self, tick: int, due: Sequence[ReplicatedOutput]) -> int | None:
        """Return the number of the copy that has strayed in a cycle. None if there is no majority.

        Args:
            tick: Release tick of the cycle.
            due: Outputs that it has written. Their messages have been fetched.
        """
        active = self._group[Block.ACTIVE]
        word = self._find_vote_word(tick)
        for number, block in enumerate(self._blocks):
            if number not in (active, self.right.number):
                if block[word] == self.block[word]:
                    return active
                if block[word] == compute_vote(tick, (output.published for output in due)):
                    return self.right.number
        return None

    def _find_vote_word(self, tick: int) -> int:
        """Return the word for the vote in a cycle. Successive cycles have different words."""
        return Block.VOTE + tick // self.spec.every % 2

    def _realign_level(self, tick: int) -> None:
        """Let the level continue from the state that the active copy has written at `tick`."""
        for output in self._outputs:
            if output.spec.name.endswith(STATE_SUFFIX) and output.fetch_message(tick):
                self.executor.realign(output.slots.message)

    def _list_due(self, tick: int) -> list[ReplicatedOutput]:
        """Return the outputs that the cycle released at `tick` writes."""
        return [
            output
            for output in self._outputs
            if (tick + output.spec.due_offset) % output.spec.every == 0
        ]

    def _write_or_hold(self, tick: int, now: int | None) -> bool:
        """Write the messages of a cycle if this copy is active, and hold them back otherwise."""
        if self.right.permits_writing:
            return self._write(tick, now)
        self._held_tick = tick
        due = self._list_due(tick)
        for output in due:
            output.hold_message(tick)
        if self._votes:
            vote = compute_vote(tick, (output.held for output in due))
            self.block[self._find_vote_word(tick)] = vote
        return True

    def _report_findings(self, tick: int) -> None:
        """Report findings if this copy is active. Otherwise drop them."""
        if not self.right.is_held:
            self.executor.findings.clear()
            self.executor.acted.clear()
        super()._report_findings(tick)


def compute_vote(tick: int, messages: Iterable[bytes | memoryview]) -> int:
    """Return a checksum of the messages of a cycle, 63 bits. It depends on the tick too."""
    return xxh3_64_intdigest(b"".join(messages), tick) >> 1
