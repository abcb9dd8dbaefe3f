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
"""Late by 12 us, but for one wake at 2.5 ms and two beyond its histogram, of which the longest is
known."""
REFUSED = """\
import sys
sys.exit("Unable to change scheduling policy!")
"""
HALRUN = """\
import ctypes, os, sys
for line in sys.stdin:
    words = line.split()
    if words[0] == "loadrt" and words[1] == "threads":
        ctypes.CDLL(None).prctl(15, b"rtapi_app:T#0", 0, 0, 0)
        period = int(words[3].partition("=")[2])
    if words[:3] == ["loadusr", "-w", "halsampler"]:
        early = ["0", "203155", str(period + 7)]
        others = [str(period), str(period + 5000), str(period - 5000)] * (int(words[4]) // 3)
        print("\\n".join([*early, *others]))
"""
"""A thread whose every third run is 5 us late, behind LinuxCNC's command line."""


def program(folder: Path, name: str, text: str) -> Path:
    """Write a program in Python, to be found on a path; return its folder."""
    path = folder / name
    path.write_text(f"#!{sys.executable}\n{text}")
    path.chmod(0o755)
    return folder
