"""Build hook of the wheel: adds the package `rack` and the module of its command.

An editable install has links to both in `.venv/src`, which copies would hide.
"""

from __future__ import annotations

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FILES = {"tools/front/rack": "rack", "tools/front/nasrem_rack.py": "nasrem_rack.py"}


class FrontHook(BuildHookInterface[Any]):
    """Build hook that places the files of this folder at the root of a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files, unless the install is editable."""
        if version != "editable":
            build_data["force_include"].update(FILES)
