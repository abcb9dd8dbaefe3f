"""Names of a package that are imported on first use.

A program that uses one name does not wait for the libraries that other names need.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def build_lazy_getattr(package: str, places: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Build the module-level `__getattr__` of a package that imports its names on first use.

    Args:
        package: Name of the package, for error messages.
        places: Dictionary from each module to the exported names that it defines.
    """
    module_of = {name: module for module, names in places.items() for name in names}

    def import_name(name: str) -> Any:
        """Import the module that defines an exported name, and return the object."""
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(module_of[name]), name)

    return import_name
