"""Injecting faults from the host side: the kinds there are, and a running rack to have them."""
