"""Installed, the project is one import name, `rack`, and a user's folders keep their own names."""

from __future__ import annotations

import json
import os
import shutil
import sys
import sysconfig
import tomllib
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

from tests.processes import run_to_end

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).resolve().parent.parent
FLOORS = ("backplane", "boards", "configs", "levels", "tools")
FILES = ("pyproject.toml", "README.md", "LICENSE")
LEVEL = """
from rack.backplane.message import State, Status, field
from rack.levels.level import Executor, Output
from tools.numbers import THREE

class Count(Status, version=1):
    count: int = field("u4", unit="1", doc="cycles so far")


class Counter(Executor):
    status = Output(Count)

    def process(self, tick):
        self.status.state = State.EXECUTING
        self.status.count += THREE
"""
CONFIG = """
format = 2
name = "NAME"
python_path = ["."]

[clock]
period_ms = 2.5

[board.counter]
slot = 2
rate_hz = 100
executor = "levels.counter:Counter"
"""


def run(folder: Path, *command: str | Path) -> str:
    # Code that is compiled for the copy goes with it.
    done = run_to_end(
        command, 100, cwd=folder, env={**os.environ, "XDG_CACHE_HOME": str(folder / "cache")}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the programs of an environment that has the project's wheel, and the libraries of this
    one."""
    folder = tmp_path_factory.mktemp("install")
    (folder / "source").mkdir()
    for name in FLOORS:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, folder / "source" / name, ignore=ignored)
    for name in FILES:
        shutil.copy(ROOT / name, folder / "source" / name)
    pip = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
    offline = ("--no-deps", "--no-index")
    # As `make dist` does: a source archive, and the wheel from it.
    build = (sys.executable, "-m", "build", "--no-isolation", "--outdir", folder)
    run(folder, *build, folder / "source")
    venv.create(folder / "clean")
    programs = folder / "clean" / "bin"
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    purelib = run(folder, programs / "python", "-c", where)
    # Only the libraries of this environment are seen there: an editable install is found by a hook,
    # which is not.
    Path(purelib.strip(), "libraries.pth").write_text(sysconfig.get_path("purelib"))
    wheel = next(folder.glob("*.whl"))
    run(folder, *pip, "--python", programs / "python", "install", *offline, wheel)
    return programs


def test_the_wheel_runs_the_nasrem_rack_from_another_folder(
    installed: Path, tmp_path: Path
) -> None:
    where = "import rack.boards.config.files as f; print(f.__file__)"
    place = run(tmp_path, installed / "python", "-c", where)
    assert place.startswith(str(installed.parent))
    names = "import rack; print(rack.Rack, rack.attach, rack.open_run, rack.__file__)"
    assert str(installed.parent) in run(tmp_path, installed / "python", "-c", names)
    name = f"installed-{os.getpid()}"
    words = ("run", "nasrem", "--set", f"name={name}", "--lockstep", "--seconds", "1", "--json")
    report = json.loads(run(tmp_path, installed / "rack", *words))
    assert (report["worked"], report["simulated_s"]) == (True, 1.0)


def test_folders_of_a_user_may_be_called_tools_and_levels(installed: Path, tmp_path: Path) -> None:
    for package, file, text in (
        ("tools", "numbers.py", "THREE = 3\n"),
        ("levels", "counter.py", LEVEL),
    ):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
        (tmp_path / package / file).write_text(text)
    (tmp_path / "own.toml").write_text(CONFIG.replace("NAME", f"own-{os.getpid()}"))
    words = ("run", "own.toml", "--lockstep", "--seconds", "0.5", "--json")
    assert json.loads(run(tmp_path, installed / "rack", *words))["worked"]


def test_wheel_and_source_archive_are_of_one_version(installed: Path, tmp_path: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    version = project["version"]
    with ZipFile(next(installed.parents[1].glob("*.whl"))) as wheel:
        tops = {name.partition("/")[0] for name in wheel.namelist()}
    assert {name for name in tops if not name.endswith(".dist-info")} == {"rack", "nasrem_rack.py"}
    names = sorted(path.name for path in installed.parents[1].glob("nasrem_rack-*"))
    assert names == [f"nasrem_rack-{version}-py3-none-any.whl", f"nasrem_rack-{version}.tar.gz"]
    assert run(tmp_path, installed / "rack", "--version") == f"rack {version}\n"
    assert f"## {version} (" in (ROOT / "CHANGELOG.md").read_text()
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"`pip install {names[0]}`" in (ROOT / "README.md").read_text()


def test_a_folder_called_rack_is_not_taken_for_the_project(tmp_path: Path) -> None:
    for floor in FLOORS:
        (tmp_path / "rack" / floor).mkdir(parents=True)
    found = run(tmp_path, sys.executable, "-c", "import rack.tools.cli as cli; print(cli.__file__)")
    assert found.strip() == str(ROOT / "tools" / "cli.py")


def answer(program: Path, **environment: str) -> tuple[int, str]:
    done = run_to_end((program, "list"), 100, env={**os.environ, **environment})
    return done.returncode, done.stdout + done.stderr


def test_a_package_rack_of_others_that_is_found_first_is_named(tmp_path: Path) -> None:
    (tmp_path / "rack").mkdir()
    (tmp_path / "rack" / "__init__.py").write_text("stand = 19")
    status, text = answer(Path(sys.executable).with_name("rack"), PYTHONPATH=str(tmp_path))
    place = tmp_path / "rack" / "__init__.py"
    assert (status, text) == (
        1,
        f"rack: {place} is not nasrem-rack's package `rack`: remove it from PYTHONPATH\n",
    )


def test_a_distribution_rack_that_was_installed_over_ours_is_named(installed: Path) -> None:
    place = next(installed.parent.glob("lib/python3*/site-packages/rack/__init__.py"))
    other = place.parents[1] / "rack-0.1.4.dist-info"
    ours = place.read_text()
    try:
        place.write_text("from .dict import dict_rack")
        place.with_name("dict.py").touch()
        other.mkdir()
        (other / "METADATA").write_text("Metadata-Version: 2.1\nName: rack\nVersion: 0.1.4\n")
        status, text = answer(installed / "rack")
    finally:
        place.write_text(ours)
        place.with_name("dict.py").unlink()
        shutil.rmtree(other)
    assert status == 1
    assert text.startswith(f"rack: {place} is not nasrem-rack's package `rack`: uninstall the")
    assert text.count("\n") == 1
