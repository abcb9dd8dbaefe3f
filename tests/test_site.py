"""`make docs` builds the pages as a site that needs no network, and a broken link is an error."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pages import ROOT, list_pages
from tests.processes import run_to_end

BOUND_S = 300
pytestmark = [pytest.mark.thorough, pytest.mark.timeout(BOUND_S + 20)]

LEFT_OUT = shutil.ignore_patterns(".git", ".venv", ".*_cache", "__pycache__", "dist", "runs")
BROKEN = {
    "levels/gone.md": "levels/gone.md",
    "tools/README.md#gone": "#gone",
    "tools/gone.py": "tools/gone.py",
}
"""Links, each with what the error must name."""


def build(project: Path, site: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    return run_to_end(command, BOUND_S, cwd=project, env=environment)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    done = build(ROOT, folder)
    assert done.returncode == 0, done.stderr
    return folder


def test_the_site_has_every_page_and_the_code_that_pages_link_to(site: Path) -> None:
    made = [Path(name).with_suffix(".html") for name in list_pages()]
    made = [path.with_name("index.html") if path.stem == "README" else path for path in made]
    assert not [str(path) for path in made if not (site / path).exists()]
    assert "class VirtualControlLoop" in re.sub(
        "<.*?>", "", (site / "boards" / "run" / "control_loop.py.html").read_text()
    )


def test_the_navigation_names_each_page_once(site: Path) -> None:
    links = re.findall(r'<a href="([^"#]+)" class="md-nav__link', (site / "index.html").read_text())
    assert len(links) > 50
    assert not {link for link in links if links.count(link) > 1}


def test_the_api_reference_is_made_from_docstrings(site: Path) -> None:
    launched = (site / "tools" / "PYTHON.html").read_text()
    assert "A rack launched by a program." in launched
    assert 'id="rack.tools.scripting.attached.AttachedRack.wait_until"' in launched
    levels = (site / "levels" / "API.html").read_text()
    assert 'id="rack.levels.level.Executor.process"' in levels


def test_the_site_needs_no_network(site: Path) -> None:
    loads = re.compile(r"""<(?:script|img|iframe)[^>]*\ssrc=["']?(?:https?:)?//|<link[^>]*//""")
    pages = list(site.rglob("*.html"))
    assert len(pages) > 50
    assert not [str(page) for page in pages if loads.search(page.read_text())]


def test_each_broken_link_is_an_error(tmp_path: Path) -> None:
    project = shutil.copytree(ROOT, tmp_path / "project", ignore=LEFT_OUT)
    with (project / "README.md").open("a") as page:
        page.writelines(f"\nSee [gone]({link}).\n" for link in BROKEN)
    done = build(project, tmp_path / "site")
    assert done.returncode == 1
    assert not [error for error in BROKEN.values() if error not in done.stderr]
