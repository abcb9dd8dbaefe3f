"""Motion along a path in joint space: its geometry, limits and timing, as pure functions."""
