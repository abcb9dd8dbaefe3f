"""The experiments of `rack reproduce`: measurements whose results are plain data."""
