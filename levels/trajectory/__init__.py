"""A trajectory level that follows a queue of motion requests: segments in joint or Cartesian space, blended."""
