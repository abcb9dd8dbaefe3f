"""Campaigns: many trials with random faults of all kinds, and their evaluation."""
