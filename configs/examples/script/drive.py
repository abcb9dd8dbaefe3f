"""Run a rack from Python: watch it, hold its task for a second, kill a board, let it finish.

python drive.py [SECONDS]
"""

from __future__ import annotations

import sys

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.words import System
from rack.boards import Rack

SETTINGS = [
    "name='driven'",
    "clock.mode='lockstep'",  # without this line: in real time
    "fault=[{kind='kill', board='primitive', at=9.0}]",
]
SHOWN = {"command", "detection", "reaction", "recovery", "end"}


def main(seconds: float | None = None) -> int:
    """Run the rack, and return an exit status.

    Args:
        seconds: Simulated duration of the run. None to run until the task ends.
    """
    with Rack.from_file("nasrem", SETTINGS) as rack:
        rack.command("task", "hold", tick=2600)
        rack.command("task", "resume", tick=3000)
        # Reads the newest message of a mailbox without delaying any board.
        servo = open_observer(rack.segment, "servo.status")
        rack.start(seconds)
        seen = 0
        while rack.watch(timeout_s=0.5):
            if (newest := servo.peek()).has_message:
                joints = ", ".join(f"{q:6.3f}" for q in newest.message.position)
                print(f"tick {rack.segment.words[System.TICK]:6}  joints {joints} rad")
            for event in rack.events[seen:]:
                if event.kind in SHOWN:
                    print(f"tick {event.tick:6}  {event.kind}: {event.text}")
            seen = len(rack.events)
        outcome = rack.outcome
    print(f"{outcome.cause} after {outcome.ticks} ticks, digest {outcome.digest}")
    return 0 if outcome.is_success else 1


if __name__ == "__main__":
    sys.exit(main(*map(float, sys.argv[1:])))
