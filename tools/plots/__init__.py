"""Plots of signals over simulated time, on the terminal and as pictures."""
