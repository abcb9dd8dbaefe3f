"""The command line of another checkout: it runs its own files, in every process that it starts."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from rack.tools.console.answer import Failure
from rack.tools.lab.benches.checkout import checkout, this_rack
from tests.tools.command_line import BOUND_S, ROOT, rack

MAIN = """
import subprocess, sys

def main():
    if "fail" in sys.argv:
        sys.exit("first line\\nthe reason")
    if "lack" in sys.argv:
        import no_such_package
    if "wait" in sys.argv:
        sys.stdin.close()
        import threading
        threading.Event().wait()
    import given
    child = "import {package}cli; print({package}cli.__file__)"
    done = subprocess.run([sys.executable, "-c", child], capture_output=True)
    print(sys.argv, __file__, done.stdout.decode())
"""


def tree_of(folder: Path, package: str, mapping: str = "") -> Path:
    (folder / "tools").mkdir(parents=True)
    (folder / "tools" / "__init__.py").touch()
    (folder / "tools" / "cli.py").write_text(MAIN.format(package=package))
    (folder / "pyproject.toml").write_text(
        f'[project.scripts]\nrack = "{package}cli:main"\n{mapping}'
    )
    return folder


@pytest.mark.parametrize("layout", ["bare", "in one namespace"])
def test_a_checkout_and_its_children_run_their_own_files(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "extra").mkdir()
    (tmp_path / "extra" / "given.py").touch()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "extra"))
    # Started from another tree, whose packages have the same names.
    monkeypatch.chdir(ROOT)
    mapping = '[tool.setuptools.package-dir]\n"rack.tools" = "tools"\n'
    bare = layout == "bare"
    package, mapping = ("tools.", "") if bare else ("rack.tools.", mapping)
    tree = tree_of(tmp_path / "other", package, mapping)
    with checkout(tree) as found:
        argv, own, child = found.run("run", 3, bound_s=BOUND_S).rsplit(maxsplit=2)
        assert argv == "['rack', 'run', '3']"
        assert [Path(own).resolve(), Path(child).resolve()] == [tree / "tools" / "cli.py"] * 2
        assert (found.name, found.package) == ("other", "" if bare else "rack.")
        links = [
            path
            for path in found.environment["PYTHONPATH"].split(os.pathsep)
            if "rack-bench-" in path
        ]
    assert not any(Path(link).exists() for link in links)


def test_this_tree_is_a_checkout_too() -> None:
    with checkout(ROOT) as found:
        assert found.run("--help", bound_s=BOUND_S) == this_rack().run("--help", bound_s=BOUND_S)


@pytest.mark.slow
def test_a_command_that_fails_or_hangs_is_one_line(tmp_path: Path) -> None:
    with checkout(tree_of(tmp_path / "other", "tools.")) as found:
        with pytest.raises(Failure, match=r"^other: rack fail now: the reason$"):
            found.run("fail", "now", bound_s=BOUND_S)
        with pytest.raises(
            Failure, match=r"^other: rack lack: .*no_such_package'; give the folder .* PYTHONPATH$"
        ):
            found.run("lack", bound_s=BOUND_S)
        with pytest.raises(Failure, match=r"^other: rack wait: still running after 0.5 s$"):
            found.run("wait", bound_s=0.5)


def test_a_path_that_is_no_checkout_is_refused_in_one_line(tmp_path: Path) -> None:
    project = tmp_path / "pyproject.toml"
    mistakes = [
        (tmp_path / "nowhere", None, "nowhere: not a checkout of rack: no such folder"),
        (tmp_path, None, "not a checkout of rack: it has no pyproject.toml"),
        (tmp_path, "[project", "pyproject.toml: Expected ']'"),
        (tmp_path, "[project.scripts]\nother = 'a:b'", "its pyproject.toml has no script 'rack'"),
        (
            tmp_path,
            (
                "[project.scripts]\nrack ="
                " 'rack.tools.cli:main'\n[tool.setuptools.package-dir]\n'rack.tools' = 'tools'"
            ),
            "it has no folder tools",
        ),
    ]
    for tree, text, reason in mistakes:
        if text is not None:
            project.write_text(text)
        with pytest.raises(Failure) as refused, checkout(tree):
            pass
        assert reason in str(refused.value)
        assert len(str(refused.value).splitlines()) == 1
        assert refused.value.status == 2


@pytest.mark.parametrize("bench", ["cycle", "lockstep"])
def test_a_bench_against_no_checkout_is_a_usage_error(bench: str, tmp_path: Path) -> None:
    done = rack("bench", bench, "--against", tmp_path / "nowhere", "--json")
    reason = f"{tmp_path / 'nowhere'}: not a checkout of rack: no such folder"
    assert (done.returncode, done.stderr.strip(), json.loads(done.stdout)["error"]) == (
        2,
        reason,
        [reason],
    )
