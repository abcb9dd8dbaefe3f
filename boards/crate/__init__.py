"""The Rack and its crate: boards launched, supervised, ended; or their levels, in one process."""
