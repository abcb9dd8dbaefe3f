"""Motion planning for an arm: inverse kinematics, collisions, payloads and paths.

Everything is deterministic: equal arguments give equal results in any process.
"""
