"""Planning for an arm: inverse kinematics, collisions, payloads, paths. Equal questions give equal answers, in any
process.
"""
