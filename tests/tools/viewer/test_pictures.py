"""Pictures without a screen: a missing graphics driver, and the viewer's network access."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from rack.tools.viewer.pictures import NoViewerError, _connect_client
from rack.tools.viewer.window import ViewerWindow, find_free_port

ROOT = Path(__file__).resolve().parents[3]
BOUND_S = 60
NO_DRIVER = {
    "VK_DRIVER_FILES": "/nowhere",
    "VK_ICD_FILENAMES": "/nowhere",
    "WGPU_BACKEND": "vulkan",
}
LOOPBACK, LISTENS = "0100007F", "0A"


@pytest.mark.slow
def test_without_a_driver_the_cause_and_what_to_install_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in NO_DRIVER.items():
        monkeypatch.setenv(name, value)
    files = (tmp_path / "run.rrd", tmp_path / "out.png")
    command = [sys.executable, "-m", "rack.tools.viewer.pictures", *files, "--at", "1"]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=BOUND_S, check=False
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "No graphics adapter was found" in line
    assert re.search(
        "missing packages: apt-get install|no package for drawing is missing|these Debian packages",
        line,
    )


def test_the_viewer_listens_to_this_machine_alone() -> None:
    port = find_free_port()
    window = ViewerWindow(headless=True, port=port)
    try:
        _connect_client(window, port)
        sockets = [
            line.split()[1:4]
            for name in ("tcp", "tcp6")
            for line in Path("/proc/net", name).read_text().splitlines()
        ]
        found = [
            place
            for place, _, state in sockets
            if place.endswith(f":{port:04X}") and state == LISTENS
        ]
    except NoViewerError as error:
        pytest.skip(str(error))
    finally:
        window.close()
    assert found == [f"{LOOPBACK}:{port:04X}"]
