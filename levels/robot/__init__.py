"""Robot and cell, built from `[robot]` and `[scene]`: model, limits, linkage of the gripper,
dynamics.

No exports: importing MuJoCo takes half a second, and not every importer of a module here needs all
of them.
"""
