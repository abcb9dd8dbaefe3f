"""The view of a run: everything that a rack wrote, as a recording for the rerun viewer.

This package imports rerun, which starts threads that no board may inherit. Therefore only the
recorder process, and tools that read a recording, import it.
"""
