"""Racks of other machines, and the credentials of racks that work together."""
