"""Motion along a path in joint space: its geometry, the limits of its parameter, its timing. Pure
functions of data.
"""
