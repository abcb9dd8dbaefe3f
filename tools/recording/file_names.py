"""Names of files in the folder of a run."""

from __future__ import annotations

CONFIG = "config.toml"
"""The resolved config."""
PUBLISHED = "published.json"
"""Facts about the rack's levels, see `rack.boards.config.published`."""
SPOOL = "recorder.spool"
"""Rows that are not yet in the tables; the recorder keeps it open."""
ORIGIN = "origin.json"
"""The run from which this one continues."""
CODE = "code.json"
"""Versions and digests of the code and files with which the run was made."""
