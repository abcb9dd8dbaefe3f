"""Levels that only racks other than NASREM's use.

They belong to the other historical systems: state tables, trajectories, force control, hands, and
work shared by several racks.
"""
