"""Entry of the `rack` command.

This module is outside the package `rack`, so that it can detect that another distribution's package
`rack` is imported instead.
"""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path


def main() -> None:
    """Run the command line, or exit with one line if another package `rack` takes precedence."""
    place = _find_package()
    if "nasrem-rack" not in place.read_text():
        sys.exit(f"rack: {place} is not nasrem-rack's package `rack`: {_describe_remedy()}")
    from rack.tools.cli import main as run

    run()


def _find_package() -> Path:
    """Return the file of the package `rack` that would be imported, without importing it."""
    spec = find_spec("rack")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin)


def _describe_remedy() -> str:
    """Return how to remove the other package, which overwrites ours or precedes it on the path."""
    try:
        version("rack")
    except PackageNotFoundError:
        return "remove it from PYTHONPATH"
    return (
        "uninstall the distribution 'rack' (pip uninstall rack), then install nasrem-rack again"
        " (pip install --force-reinstall nasrem-rack)"
    )
