"""Look-up of level classes by name, as in "package.module:Class", and the folders to search."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from rack.levels.references import find_class

__all__ = ["extend_path", "find_class"]


def extend_path(folders: Sequence[Path]) -> None:
    """Append folders to Python's import path, except those that it already contains."""
    sys.path += [str(folder) for folder in folders if str(folder) not in sys.path]
