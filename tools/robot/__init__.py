"""Brings up an arm from a model file: reads it, drafts a config, finds a task, writes a folder.

This package exports nothing. MuJoCo and the planner take a second to import, and only `rack robot`
needs them.
"""
