"""The paper's timing model: its equations, and beyond them what tasks that share a core do to each other."""
