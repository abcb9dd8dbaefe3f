"""Robot and cell, built from `[robot]` and `[scene]`: model, limits, gripper linkage, dynamics.

The package exports nothing: importing MuJoCo takes half a second, and not every user of a module of
this package needs all of them.
"""
