"""Input and output of all commands: arguments, answers, tables, pictures, progress, signals.

Nothing in this package knows about runs.
"""
