"""Shared by all commands: arguments, answers, tables, progress, signals. Nothing here knows of
runs.
"""
