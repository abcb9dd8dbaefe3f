"""A rack as a node of ROS 2, without ROS: by zenoh as rmw_zenoh does, or by DDS."""
