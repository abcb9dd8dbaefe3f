"""A GRIPPER segment under way: the gripper goes to an opening, as far as its force takes it."""

from __future__ import annotations

from rack.backplane.message import Message
from rack.levels.messages import Error
from rack.levels.primitive.fault import Fault
from rack.levels.primitive.path_work import WorkRules
from rack.levels.primitive.segment import Segment
from rack.levels.primitive.tracking import HANDOVER_CYCLES
from rack.levels.tables import GripperConfig


class GripperWork:
    """One GRIPPER segment under way; it is done when the gripper has come to rest, wherever that is."""

    def __init__(self, segment: Segment, gripper: GripperConfig, rules: WorkRules) -> None:
        self.segment = segment
        self._closes = abs(segment.opening - gripper.closed) < abs(segment.opening - gripper.open)
        self.fault: Fault | None = None
        self._rules = rules
        self.begin()

    def begin(self) -> None:
        """Wait anew until the gripper has come to rest: at the beginning, and when the servo has been away."""
        self._cycles = 0
        self._quiet = self._rules.quiet()

    @property
    def held_after(self) -> int | None:
        """The object in the gripper afterwards: the segment's, if it goes nearer to closed than to open."""
        return self.segment.object if self._closes else None

    def done(self, status: Message) -> bool:
        """Say whether the gripper has come to rest."""
        self._cycles += 1
        # Before the command has reached it, the gripper rests too.
        if self._cycles <= HANDOVER_CYCLES:
            return False
        speed, permitted = abs(status.opening_velocity), self._rules.params.settled_opening
        settled = self._quiet.settled(speed < permitted)
        if self._quiet.overdue and not settled:
            reason = f"gripper still moves at {speed:.4f} m/s; below {permitted} is at rest"
            self.fault = Fault(Error.FOLLOWING, reason)
        return settled
