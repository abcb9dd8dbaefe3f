"""Cycle of a board: tasks, ports, stopwatch, system controller and snapshots."""
