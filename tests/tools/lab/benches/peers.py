"""Stand-ins for programs of Debian packages, which a machine that runs the tests may lack."""

from __future__ import annotations

import sys
from pathlib import Path

CYCLICTEST = """\
import json, sys
options = dict(word.lstrip("-").split("=") for word in sys.argv[1:] if "=" in word)
count = int(options["loops"])
histogram = {"12": count - 3, "2500": 1}
thread = {"histogram": histogram, "min": 12, "max": 150000, "cycles": count}
threads = {str(number): thread for number in range(int(options["threads"]))}
with open(options["json"], "w") as file:
    json.dump({"thread": threads}, file)
"""
"""Program whose wakes are late by 12 us, except one at 2.5 ms and two beyond its histogram.

Only the longest of the latter is known.
"""
REFUSED = """\
import sys
sys.exit("Unable to change scheduling policy!")
"""


def program(folder: Path, name: str, text: str) -> Path:
    """Write a Python program that can be found on a path, and return its folder."""
    path = folder / name
    path.write_text(f"#!{sys.executable}\n{text}")
    path.chmod(0o755)
    return folder
