"""Names of files in the folder of a run."""

from __future__ import annotations

CONFIG = "config.toml"
"""The resolved config."""
PUBLISHED = "published.json"
"""Description of the rack's levels, see `rack.boards.config.published`."""
SPOOL = "recorder.spool"
"""Spool of the recorder, with rows that are not in the tables yet. A recorder keeps it open."""
ORIGIN = "origin.json"
"""The run from which this one continues."""
JOINED = "joined.json"
"""Predicted responses along boards of several racks that end in this one."""
CODE = "code.json"
"""Versions and digests of the code and files that produced the run."""
