"""The commands, and what they need: recording, timing, faults, viewer, network, lab."""
