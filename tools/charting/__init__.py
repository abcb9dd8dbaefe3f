"""Gantt charts of schedules and of runs, and the regions of figure 5, as text and as pictures."""
