"""The recorder: a process of its own that drains a rack's rings into Parquet files."""
