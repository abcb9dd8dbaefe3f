"""What `rack reproduce` runs: measurements whose results are plain data."""
