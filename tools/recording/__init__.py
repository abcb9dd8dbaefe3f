"""Files of a run, which the recorder process writes and all other tools read."""
