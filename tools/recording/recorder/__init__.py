"""The recorder, a separate process that copies a rack's rings into the files of a run."""
