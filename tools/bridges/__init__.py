"""Bridges, which connect a running rack to other people's tools, each in a process of its own."""
