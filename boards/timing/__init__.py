"""The paper's timing model and its extension to tasks that share a core, as pure functions on plain
data.
"""
