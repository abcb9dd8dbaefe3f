"""The programming side: verbs that start and stop motions, and new verbs made of them.

A verb is started, runs on the real-time side, and ends or is stopped. `GuardedLine` is made of two others, without a
change to either: a line, and a guard that watches a sensor through the bridge and stops the line.
"""

from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from rack.levels.host_program import Bus, HostProgram
from rack.levels.joint_messages import ARM_STATUS
from rack.levels.level import Input
from rack.levels.trajectory.commands import Motions
from rack.levels.trajectory.messages import MOTION_REQUEST, MOTION_STATUS

PRESSED, WINDOW = 6.0, 12
"""Change of a joint's torque that counts as touch, N m, and the samples within which it must happen."""
STEADY = 0.15
"""Part of a guarded move that it needs to reach its speed."""
PLACE = (0.70, 0.30)
"""Where the blocks go, m."""
SLOW = 0.03
"""Speed of a guarded move, m/s."""


class Verb:
    """A motion on the real-time side: started, then running until it ends or is stopped."""

    def __init__(self, motions: Motions, begin: Callable[[], int]) -> None:
        self.motions, self._begin = motions, begin
        self.request = 0

    def start(self) -> "Verb":
        """Start it: the motion is queued, and begins when those before it have ended."""
        self.request = self._begin()
        return self

    def stop(self) -> None:
        """Stop it, with all that is queued: the arm ramps to rest."""
        self.motions.wait(self.motions.cancel())

    def run(self) -> None:
        """Start it, and wait for its end."""
        self.start().motions.wait(self.request)


class Guard:
    """Watches the arm's torques, which pass the bridge in every fourth of its cycles, during one motion."""

    def __init__(self, bus: Bus, request: int) -> None:
        self._bus, self._request = bus, request
        self._past: deque[np.ndarray] = deque(maxlen=WINDOW)

    def is_pressed(self) -> bool:
        """Return whether a torque has just changed by more than slow motion explains."""
        motion, sensors = self._bus.read("motion").value, self._bus.read("sensors")
        if motion.current != self._request or motion.progress < STEADY or not sensors.is_new:
            return False
        self._past += [np.array(message.torque) for message in (*sensors.earlier, sensors.value)]
        return len(self._past) == WINDOW and bool(np.abs(self._past[-1] - self._past[0]).max() > PRESSED)


class GuardedLine:
    """A new verb: a line of the tool that stops where the arm meets something."""

    def __init__(self, line: Verb, bus: Bus) -> None:
        self._line, self._bus = line, bus

    def run(self) -> bool:
        """Run the line under guard; return whether it was stopped."""
        guard = Guard(self._bus, self._line.start().request)
        touched = not self._line.motions.wait(self._line.request, until=guard.is_pressed)
        if touched:
            self._line.stop()
        return touched


class Assembly(HostProgram):
    """Puts a block on the table, and the other one on it; how high that is, only touch tells."""

    inputs = {"motion": Input(MOTION_STATUS, "below.motion"), "sensors": Input(ARM_STATUS, "below.sensors")}
    outputs = {"requests": MOTION_REQUEST}

    def run(self, bus: Bus) -> None:
        """Carry both blocks."""
        motions = Motions(bus, self.context.robot, self.context.scene)
        for block in ("block1", "block2"):
            self._fetch(motions, block)
            touched = self._lower(motions, bus, PLACE)
            print(f"{block}: {'touched at' if touched else 'no touch down to'} {motions.where()[2]:.4f} m")
            motions.release()
            Verb(motions, lambda: motions.line((*PLACE, 0.70))).run()
        motions.wait(motions.move())

    def _fetch(self, motions: Motions, block: str) -> None:
        motions.release()
        motions.line((0.0, 0.0, 0.15), body=block)
        motions.line((0.0, 0.0, 0.0), body=block)
        motions.grip()
        motions.wait(motions.line((0.0, 0.0, 0.20), body=block))

    def _lower(self, motions: Motions, bus: Bus, place: Sequence[float]) -> bool:
        above, below = (*place, 0.62), (*place, 0.44)
        Verb(motions, lambda: motions.line(above)).run()
        line = Verb(motions, lambda: motions.line(below, segment=(above[2] - below[2]) / SLOW))
        return GuardedLine(line, bus).run()
