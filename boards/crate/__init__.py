"""Launch, supervision and end of boards: the Rack and its crate, or all levels in one process."""
