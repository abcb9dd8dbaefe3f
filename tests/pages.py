"""The pages of the project, divided between the tests that run their commands.

A reference page lists commands, each of which works alone: test_pages.py runs them. A guide is
followed from its first command to its last: test_guides.py runs it so. The exercises of the course
and the examples have test_course.py and test_examples.py, and a page of configs that has a rack of
its own a test of that rack.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
GUIDES = (
    "boards/FAULTS.md",
    "configs/ANNOTATED.md",
    "configs/TUTORIAL.md",
    "levels/DRIVES.md",
    "tools/NEIGHBOURS.md",
    "tools/PYTHON.md",
    "tools/REWIND.md",
    "tools/SIGNALS.md",
    "tools/TROUBLESHOOTING.md",
)
WITHOUT_COMMANDS = ("configs/REFERENCE.md", "levels/API.md", "tools/COMPARISON.md")
LAYERS = [
    ROOT / "ARCHITECTURE.md",
    *(ROOT / name / "README.md" for name in ("backplane", "boards", "levels", "configs", "tools")),
]
"""The page of each layer, and the map of all."""
REFERENCES = [
    README,
    *LAYERS,
    *(
        page
        for layer in LAYERS[1:]
        for page in sorted(layer.parent.glob("*.md"))
        if page != layer and str(page.relative_to(ROOT)) not in (*GUIDES, *WITHOUT_COMMANDS)
    ),
]
PAGES = [*REFERENCES, *(ROOT / name for name in (*GUIDES, *WITHOUT_COMMANDS[1:]))]
"""Pages that people write, without those of single racks, exercises and examples."""
CODE = re.compile(r"^ *```.*?^ *```$", re.DOTALL | re.MULTILINE)
SHELL = re.compile(r"```sh\n(.*?)```", re.DOTALL)
BLOCK = re.compile(r"<!-- test: (\S+) -->\n```\w+\n(.*?)```", re.DOTALL)
"""A program or file, and its name."""


def list_pages() -> list[str]:
    """Return all pages of the project, as git has them."""
    command = ["git", "ls-files", "*.md"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.split()
