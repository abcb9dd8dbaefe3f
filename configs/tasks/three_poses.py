"""Script with the poses of three-poses.toml, for a command environment."""

POSES = (
    (0.8691, 1.367, -2.9103, 0.0, -1.5983, 0.8691),
    (-0.2018, 1.0053, -2.5063, 0.0, -1.6406, -0.2018),
    (0.629, 1.6189, -3.0661, 0.0, -1.6945, 0.629),
)

for pose in POSES:
    # Wait, because motions are blended otherwise.
    wait(move(pose))
