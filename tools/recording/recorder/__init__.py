"""The recorder: a separate process that drains a rack's rings into the files of a run."""
