"""The `rack` command. This module stands outside the package `rack`, so that it can tell when
another distribution's package of that name is imported in its place.
"""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path


def main() -> None:
    """Run the command line of `rack`, or say in one line which package was imported instead."""
    place = _find_package()
    if "nasrem-rack" not in place.read_text():
        sys.exit(f"rack: {place} is not nasrem-rack's package `rack`: {_remedy()}")
    from rack.tools.cli import main as run

    run()


def _find_package() -> Path:
    """Return the file of the package `rack` that is imported first; not one line of it runs."""
    spec = find_spec("rack")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin)


def _remedy() -> str:
    """Return what removes the other package: one installed over ours, or one found before it."""
    try:
        version("rack")
    except PackageNotFoundError:
        return "remove it from PYTHONPATH"
    return (
        "uninstall the distribution 'rack' (pip uninstall rack), then install nasrem-rack again"
        " (pip install --force-reinstall nasrem-rack)"
    )
