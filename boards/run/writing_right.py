"""The right to write the mailboxes of a task with standbys, which one copy has at a time."""

from __future__ import annotations

from collections.abc import Collection

from rack.backplane.byte_lock import ByteLock
from rack.backplane.layout import TaskSpec
from rack.backplane.mailbox.mailbox import Writer
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, HandOver


class WritingRight:
    """The right of one copy, which is then called the active copy.

    Attributes:
        number: Number of the copy, 0 for the task itself.
        group: Control block of the task, which shows the active copy.
    """

    def __init__(
        self, segment: Segment, spec: TaskSpec, writers: Collection[Writer], alarms: AlarmWriter
    ) -> None:
        """Prepare to take the right.

        Args:
            segment: Memory of the rack.
            spec: The copy.
            writers: Writers of the copy, whose mailboxes are not claimed yet.
            alarms: Alarm ring of the copy.
        """
        layout = segment.layout
        self.number = layout.list_copies(spec.board).index(spec)
        self.group = segment.get_block(spec.board)
        self._block = segment.get_block(spec.name)
        self._lock = ByteLock(segment.fd, segment.map.blocks[spec.board] + 8 * Block.ACTIVE)
        self._index = layout.processes.index(spec)
        self._writers = writers
        self._alarms = alarms

    @property
    def is_held(self) -> bool:
        """True if this copy is the active one."""
        return bool(self.group[Block.ACTIVE] == self.number)

    @property
    def permits_writing(self) -> bool:
        """True if this copy is the active one and has claimed all mailboxes."""
        return self.is_held and all(writer.claim.is_valid for writer in self._writers)

    def take_over(self, tick: int, reason: HandOver) -> bool:
        """Claim the mailboxes, and become the active copy.

        Args:
            tick: First tick at which this copy writes.
            reason: Reason for the hand-over.

        Returns:
            False if another copy is taking over, or has been killed or stopped in doing so. Then
            try again in the next cycle.
        """
        group = self.group
        active = group[Block.ACTIVE]
        if not self._lock.take():
            return False
        try:
            if group[Block.ACTIVE] == active:
                for writer in self._writers:
                    writer.take_over()
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
        return self.is_held

    def keep_claims(self, tick: int) -> None:
        """Claim the mailboxes if this is a new process or a standby has died while taking over."""
        if self.permits_writing:
            for writer in self._writers:
                writer.claim.try_lock()
        elif not self.group[Block.TAKE_OVER]:
            # Otherwise the clock has asked another copy to take over from an earlier process.
            self.take_over(tick, HandOver.LOST)

    def release_claims(self) -> None:
        """Release claims that another copy has taken over while this one was late or stopped."""
        for writer in self._writers:
            if writer.claim.is_taken:
                writer.claim.release()
