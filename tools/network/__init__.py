"""The emergency stop of racks on other machines, and credentials of racks that work together."""
