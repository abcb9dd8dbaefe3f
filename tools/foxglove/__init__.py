"""A running rack in Foxglove."""
