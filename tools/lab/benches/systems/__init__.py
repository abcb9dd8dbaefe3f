"""Racks compared with each other: predictions, runs, kills, one motion; as tables and a picture."""
