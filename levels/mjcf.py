"""Read an MJCF file that may come from a stranger: every mistake is one `RobotError`, in bounded time and memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from rack.levels.errors import RobotError

GRID_CELLS = 4_000_000
"""Cells of one height field or texture, at most: MuJoCo allocates them while it parses (20000 x 20000 takes 10 s)."""
MODEL_BYTES = 16_000_000
"""Size of one XML file, at most."""
LONGEST_STEP_S = 0.1
"""A time step beyond this in an MJCF file is a slip, ms for s."""

GRIDS = (("nrow", "ncol"), ("width", "height"))


def load_spec(path: Path) -> mujoco.MjSpec:
    """Return the parsed, not yet compiled, MJCF file.

    Raises `RobotError` for a file that is missing, malformed, too large, includes what is outside its own folder, holds
    a NaN, or has a time step that is none.
    """
    path = Path(path)
    screen(path, path.resolve().parent, set())
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as problem:
        raise RobotError(f"model '{path}': {one_line(problem)}") from None
    step = float(spec.option.timestep)
    if not 0 < step <= LONGEST_STEP_S:
        raise RobotError(f"model '{path}': timestep {step:g} s is not valid; above 0, at most {LONGEST_STEP_S:g} s")
    return spec


def compile_spec(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """Compile. Raises `RobotError` with MuJoCo's reason in one line."""
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as problem:
        raise RobotError(f"model '{path}': {one_line(problem)}") from None


def one_line(problem: Exception) -> str:
    """Return MuJoCo's message without its line breaks."""
    return " ".join(str(problem).split()).removeprefix("Error: ")


def screen(path: Path, folder: Path, seen: set[Path]) -> None:
    """Check one XML file and what it includes, before MuJoCo reads them. Raises `RobotError`."""
    if not path.is_file():
        raise RobotError(f"model '{path}': no such file")
    if path.stat().st_size > MODEL_BYTES:
        raise RobotError(f"model '{path}': {path.stat().st_size} bytes; at most {MODEL_BYTES} are read")
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError) as problem:
        raise RobotError(f"model '{path}': malformed XML: {problem}") from None
    seen.add(path.resolve())
    for element in root.iter():
        for mistake in mistakes(element):
            raise RobotError(f"model '{path}': {mistake}")
        if element.tag == "include":
            included = (folder / element.get("file", "")).resolve()
            if not included.is_relative_to(folder):
                raise RobotError(f"model '{path}': include '{element.get('file')}' leaves the model's folder")
            if included not in seen:
                screen(included, folder, seen)


def mistakes(element: ElementTree.Element) -> Iterator[str]:
    """Yield what is wrong with one element: a NaN, a grid that would not fit."""
    for name, value in element.attrib.items():
        if name != "name" and "nan" in value.lower() and any(math.isnan(x) for x in numbers(value)):
            yield f"<{element.tag}> '{element.get('name', '')}': {name} = '{value}' is not a number"
    for first, second in GRIDS:
        cells = math.prod(max(numbers(element.get(key, "0")), default=0.0) for key in (first, second))
        if cells > GRID_CELLS:
            yield f"<{element.tag}> '{element.get('name', '')}': {first} x {second} = {cells:g}; at most {GRID_CELLS}"


def numbers(text: str) -> list[float]:
    """Return the numbers among the words of an attribute."""
    found = []
    for word in text.split():
        try:
            found.append(float(word))
        except ValueError:
            continue
    return found
