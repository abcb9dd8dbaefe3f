"""Any arm from a model file: read, its parts found, limits and home completed, a folder written.

No exports: MuJoCo and the planner take a second to import, and only `rack robot` needs them.
"""
