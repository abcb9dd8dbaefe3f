"""Wipes across a surface with constant force, over an unknown step, to a wall and back.

A client process of the rack runs this script. If the wipe fails, the script ends with an error, and
the run with status 1. Without the network, by hand, at any time:
    rack run penn --set host.coordinator.external=true
    rack prompt penn coordinator configs/penn/wipe.py
"""

from rack.levels.systems.trajectory.messages import RequestEnd

X = 0.50
DOWN = (0.0, 0.0, 1.0, 0.0)
ABOVE = 0.62  # m: height of free motion
SURFACE = 0.50  # m: expected height
START = -0.25  # m, along y, as are END and BEYOND
END = 0.12
BEYOND = 0.30  # behind the wall
PRESS = 15.0  # N
STEP = 0.002  # m: distance between two checks of the force


def expect(request, end, what):
    """Wait for a request, and check how it ended.

    Args:
        request: The request.
        end: The expected end.
        what: Name of the step, for the error.

    Raises:
        RuntimeError: The request ended differently.
    """
    wait(request)
    if end_of(request) is not end:
        raise RuntimeError(f"{what}: {end_of(request).name.lower()}, not {end.name.lower()}")


def wipe(y, seconds, end, what):
    """Press on the surface while moving along it to y.

    Args:
        y: Goal in m.
        seconds: Duration of the motion.
        end: The expected end.
        what: Name of the step, for the error.

    Raises:
        RuntimeError: The force was outside its tolerance on more than a fifth of the path, or the
            request ended differently.
    """
    pressed = {}

    def check_force():
        """Record whether the force is within tolerance at this position. Never ends the motion."""
        position_step = round(where()[1] / STEP)
        pressed[position_step] = abs(wrench()["z"] - PRESS) < 0.3 * PRESS
        return False

    request = line((X, y, SURFACE), DOWN, segment=seconds)
    wait(request, until=check_force)
    expect(request, end, what)
    good_fraction = sum(pressed.values()) / len(pressed)
    if good_fraction < 0.8:
        raise RuntimeError(f"{what}: the force was wrong on {1 - good_fraction:.0%} of the way")


expect(free(), RequestEnd.DONE, "beginning")
x, y, _ = where()
# An earlier process may have left the tool anywhere, so lift it first.
line((x, y, ABOVE), DOWN)
line((X, START, ABOVE), DOWN)
guard("touch")
expect(
    line((X, START, SURFACE - 0.02), DOWN, segment=3.0), RequestEnd.GUARDED, "touching the surface"
)
expect(comply("wipe", wrench={"z": PRESS}), RequestEnd.DONE, "pressing")
wipe(END, 6.0, RequestEnd.DONE, "wiping over the edge")
guard("wall")
wipe(BEYOND, 5.0, RequestEnd.GUARDED, "touching the wall")
wipe(START, 8.0, RequestEnd.DONE, "wiping back")
expect(free(), RequestEnd.DONE, "ending compliance")
line((X, START, ABOVE), DOWN)
expect(move(), RequestEnd.DONE, "going home")
