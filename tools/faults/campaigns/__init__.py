"""Campaigns: faults of all kinds drawn at random, tried in trials, and summed up."""
