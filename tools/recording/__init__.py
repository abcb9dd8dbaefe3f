"""The files of a run: written by the recorder process, and read by everyone else."""
