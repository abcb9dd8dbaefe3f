"""Planning for an arm: inverse kinematics, collisions, payloads, paths. Deterministic, in any
process.
"""
