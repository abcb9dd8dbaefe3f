"""The viewer's side of a run: everything a rack wrote, as a recording for the rerun viewer.

It imports rerun, whose threads no board may share: only the recorder process and tools that read a
recording import it.
"""
