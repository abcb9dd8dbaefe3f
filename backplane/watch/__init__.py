"""Alarms, and what raises them about tasks and messages."""
