"""Folders of pages for tests of experiments."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.tools.lab.reproduction.experiments.experiment import Workshop


@pytest.fixture
def workshop(tmp_path: Path) -> Workshop:
    """A workshop with an empty page."""
    found = Workshop(tmp_path / "page", share=True)
    found.prepare()
    return found
