"""The paper's timing model, extended to tasks that share a core. Pure functions on plain data."""
