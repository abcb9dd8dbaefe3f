"""A rack while it runs: launched, shown, watched."""
