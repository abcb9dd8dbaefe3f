"""Shared by all commands: arguments, answers, tables, progress, signals.

Nothing in this package knows about runs.
"""
