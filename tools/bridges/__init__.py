"""Bridges from a running rack to ROS 2 and Foxglove, each in a process of its own."""
