"""Derives the name of a rack from the name of a model file."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Container

from rack.backplane.rack_name import RACK_NAME


def is_free_name(name: str, taken: Container[str]) -> bool:
    """Return True if a name is valid and not taken."""
    return re.fullmatch(RACK_NAME, name) is not None and name not in taken


def derive_name(text: str, taken: Container[str]) -> str:
    """Derive a valid name from a text, such as the name of a file.

    Args:
        text: Any text.
        taken: Names in use. `-arm` is appended to a derived name that is in use.
    """
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    name = re.sub("[^a-z0-9_-]+", "-", plain).lstrip("-_")[:40].rstrip("-_") or "arm"
    return f"{name[:36]}-arm" if name in taken else name
