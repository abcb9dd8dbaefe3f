"""The public API of a level's author."""

from __future__ import annotations

import subprocess
import sys

import rack.levels


def test_every_export_exists_once() -> None:
    names = rack.levels.__all__
    assert len(names) == len(set(names))
    assert all(hasattr(rack.levels, name) for name in names)


def test_the_public_api_does_not_import_mujoco() -> None:
    # It takes half a second; every command of the host side imports this package.
    code = "import sys, rack.levels; sys.exit('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=30, check=False).returncode == 0
