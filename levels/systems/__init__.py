"""Levels of the historical systems other than NASREM.

State tables, trajectories, force control, hands, and work shared by several racks.
"""
