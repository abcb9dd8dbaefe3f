"""Access to racks from Python: running ones, launched ones and recorded ones."""
