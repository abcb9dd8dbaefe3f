"""A rack from Python: attached while it runs, and read back."""
