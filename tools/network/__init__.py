"""Emergency stop of racks on other machines, and credentials for racks on a network."""
