"""Runs and racks in other people's tools: MCAP, rosbag2, ROS 2 and Perfetto.

Each file needs an extra of the package, and is imported only when it is used.
"""
