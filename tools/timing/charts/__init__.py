"""Gantt charts of schedules and of runs, and the paper's figure 5, as text, data and pictures."""
