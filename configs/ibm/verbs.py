"""The programming side: verbs that start motions on the real-time side.

A new verb, `guarded_line`, combines a line and a guard without changing either. The guard travels
with the request of the line.
"""

from collections.abc import Sequence

from rack.levels.host_program import Bus, HostProgram, ProgramInput, ProgramOutput
from rack.levels.systems.joint_boards.messages import ArmStatus
from rack.levels.systems.trajectory.commands import Motions
from rack.levels.systems.trajectory.messages import MotionRequest, MotionStatus, RequestEnd

TOUCH_TORQUE = 6.0
"""Change of a joint's torque in N m that counts as touch."""
MIN_OPENING = 0.01
"""Opening of the gripper in m below which it holds no block."""
GOAL = (0.70, 0.30)
"""Goal of the blocks: x and y in m."""
GUARDED_SPEED = 0.03
"""Speed of a guarded move in m/s."""


def guarded_line(motions: Motions, goal: Sequence[float], seconds: float) -> bool:
    """Move the tool along a line until the arm touches something.

    Args:
        motions: Motion commands of the arm.
        goal: End of the line, (3,), in m.
        seconds: Duration of the motion along the whole line.

    Returns:
        True if the arm touched something.
    """
    line = motions.line(goal, guard=TOUCH_TORQUE, segment=seconds)
    motions.wait(line)
    return motions.end_of(line) is RequestEnd.GUARDED


class Assembly(HostProgram):
    """Puts one block on the table and another on top of it, finding heights by touch."""

    motion = ProgramInput(MotionStatus, "below.motion")
    sensors = ProgramInput(ArmStatus, "below.sensors")
    requests = ProgramOutput(MotionRequest)

    def run(self, bus: Bus) -> None:
        """Move both blocks."""
        motions = Motions(bus, self.motion, self.requests, self.context)
        for block in ("block1", "block2"):
            self._fetch_block(motions, block)
            touched = self._lower_block(motions)
            motions.wait(motions.release())
            result = "touched at" if touched else "no touch down to"
            print(f"{block}: {result} {motions.where()[2]:.4f} m")
            motions.wait(motions.line((*GOAL, 0.70)))
        motions.wait(motions.move())

    def _fetch_block(self, motions: Motions, block: str) -> None:
        """Grip a block and lift it. Raises `RuntimeError` if the gripper closes on nothing."""
        motions.release()
        motions.line((0.0, 0.0, 0.15), body=block)
        motions.line((0.0, 0.0, 0.0), body=block)
        motions.wait(motions.grip())
        opening = self.sensors.read().message.opening
        if opening < MIN_OPENING:
            raise RuntimeError(f"{block}: the gripper closed to {1e3 * opening:.1f} mm, on nothing")
        motions.wait(motions.line((0.0, 0.0, 0.20), body=block))

    def _lower_block(self, motions: Motions) -> bool:
        """Lower the block until it touches something, and return whether it did."""
        above = (*GOAL, 0.62)
        below = (*GOAL, 0.44)
        motions.wait(motions.line(above))
        return guarded_line(motions, below, (above[2] - below[2]) / GUARDED_SPEED)
