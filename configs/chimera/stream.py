"""Streams motions from the command environment: a flower in the air, then one block on another.

The rack runs it as its host board `command`. By hand, at any time:
    rack run chimera --set host.command.external=true
    rack prompt chimera command configs/chimera/stream.py
"""

from math import cos, pi, sin

PETALS = 5
POINTS = 60
RADIUS = 0.16
CENTRE = (0.52, 0.0, 0.86)

# Sixty short motions, sent as fast as the queue accepts them, and blended without stops.
for point in range(POINTS + 1):
    angle = 2 * pi * point / POINTS
    reach = RADIUS * (0.6 + 0.4 * cos(PETALS * angle))
    x, y, z = CENTRE
    line((x + reach * cos(angle), y + reach * sin(angle), z), segment=0.25, acceleration=0.1)

# Put one block on the other. A goal in the frame of a body is evaluated when the motion begins.
release()
line((0.0, 0.0, 0.15), body="block1")
line((0.0, 0.0, 0.0), body="block1")
grip()
line((0.0, 0.0, 0.15), body="block1")
line((0.0, 0.0, 0.15), body="block2")
line((0.0, 0.0, 0.052), body="block2")
release()
line((0.0, 0.0, 0.20), body="block2")
move()
wait()
