"""The system clock: ticks, releases, waits, and checks that it is running."""
