"""The view of a run: everything that a rack wrote, as a recording for the rerun viewer.

This package imports rerun, whose threads no board may share. Only the recorder process and tools
that read a recording import it.
"""
