"""Config files: found by name or path, `extends` merged in, the paths they hold made absolute."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rack.boards.errors import ConfigError, Mistake

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
"""The project's own configs, beside this package in a checkout and in an installation."""
FAULTS = CONFIGS / "faults"
"""Scripts of faults, for `--faults`."""
DEEPEST = 32
"""Tables and lists within each other, and files that extend each other, at most."""
LARGEST_BYTES = 1_000_000
"""Size of one file, at most."""
INTEGER_BITS = 64
"""TOML's own; Python's have no end."""

Tables = dict[str, Any]


def read(name_or_path: str | Path) -> Tables:
    """Return the tables of a config and of all that it extends, merged.

    A name means a config of the project; what holds a '/' or ends in '.toml' is a path. Raises `ConfigError`.
    """
    return _read(_path(name_or_path, "config", CONFIGS), (), {})


def with_faults(tables: Tables, name_or_path: str | Path) -> Tables:
    """Return config tables with the faults of a script behind their own.

    A script holds `[[fault]]` tables and nothing else. A name means one of the project's own. Raises `ConfigError`.
    """
    path = _path(name_or_path, "--faults", FAULTS)
    script = _tables(path)
    wrong = [
        Mistake(f"{path.name}: {key}", None, "a script of faults holds [[fault]] tables and nothing else")
        for key, value in script.items()
        if key != "fault" or not isinstance(value, list)
    ]
    if wrong:
        raise ConfigError(wrong)
    own = tables.get("fault", [])
    return {**tables, "fault": [*(own if isinstance(own, list) else []), *script.get("fault", [])]}


def names(folder: Path = CONFIGS) -> list[str]:
    """Return the names of the project's own racks, or of what else lies in a folder of configs."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def _path(name_or_path: str | Path, place: str, folder: Path) -> Path:
    text = str(name_or_path)
    is_path = isinstance(name_or_path, Path) or "/" in text or text.endswith(".toml")
    found = file_at(Path(text) if is_path else folder / f"{text}.toml")
    if found is None:
        raise ConfigError([Mistake(place, text, f"no such file; by name: {', '.join(names(folder))}; or a path")])
    return found


def file_at(path: Path) -> Path | None:
    """Return the absolute path of a file; None where there is none, nor could be: a name too long, an unknown ~user."""
    try:
        path = path.expanduser()
        return path.resolve() if path.is_file() else None
    except (OSError, RuntimeError, ValueError):
        return None


def parse(text: str, place: str = "config") -> Tables:
    """Return the tables of TOML text. Raises `ConfigError` with the line that is not TOML, or a value out of bounds."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([Mistake(place, None, f"not TOML: {error}")]) from None
    except RecursionError:
        raise ConfigError([Mistake(place, None, f"nested too deep; permitted: {DEEPEST} levels")]) from None
    except ValueError:  # Python converts no integer of thousands of digits
        raise ConfigError([Mistake(place, None, f"an integer is too long; permitted: {INTEGER_BITS} bits")]) from None
    mistakes = list(_out_of_bounds(tables, place))
    if mistakes:
        raise ConfigError(mistakes)
    return tables


def _out_of_bounds(tables: Tables, place: str) -> Iterator[Mistake]:
    """Yield what no config can hold: nesting without end, integers beyond TOML's, dates."""
    waiting: list[tuple[str, int, Any]] = [(f"{place}: {key}", 1, value) for key, value in tables.items()]
    while waiting:
        where, depth, value = waiting.pop()
        if isinstance(value, dict | list) and depth >= DEEPEST:
            yield Mistake(where, None, f"nested too deep; permitted: {DEEPEST} levels")
        elif isinstance(value, dict):
            waiting += [(f"{where}.{key}", depth + 1, item) for key, item in value.items()]
        elif isinstance(value, list):
            waiting += [(f"{where}[{at}]", depth + 1, item) for at, item in enumerate(value)]
        elif isinstance(value, int) and value.bit_length() >= INTEGER_BITS:
            yield Mistake(where, value, f"the integer is too long; permitted: {INTEGER_BITS} bits")
        elif isinstance(value, str) and "\0" in value:
            yield Mistake(where, value, "no text has a NUL")
        elif not isinstance(value, str | int | float):
            yield Mistake(
                where, str(value), "no config has a date or a time of day; permitted: numbers, text in quotes"
            )


def merge(base: Tables, top: Tables) -> Tables:
    """Return `base` with `top` over it, key by key."""
    merged = dict(base)
    for key, value in top.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            value = merge(base[key], value)
        merged[key] = value
    return merged


def _extended(base: Tables, top: Tables) -> Tables:
    """Return the tables of a file over those that it extends: a [robot] with a model of its own is another arm."""
    robot = top.get("robot")
    if isinstance(robot, dict) and "model" in robot:
        base = {key: value for key, value in base.items() if key != "robot"}
    return merge(base, top)


def anchor(tables: Tables, folder: Path) -> Tables:
    """Return the tables with their paths absolute: relative to `folder`, a bundled model also to configs/."""
    anchored = dict(tables)
    robot, own = tables.get("robot"), tables.get("python_path")
    if isinstance(robot, dict) and isinstance(robot.get("model"), str):
        anchored["robot"] = {**robot, "model": str(_find(robot["model"], folder) or folder / robot["model"])}
    if isinstance(own, list) and all(isinstance(item, str) for item in own):
        anchored["python_path"] = [str((folder / item).resolve()) for item in own]
    return anchored


def _read(path: Path, chain: tuple[Path, ...], known: dict[Path, Tables]) -> Tables:
    """Return the tables of a file and of all that it extends; `known` keeps them: two may extend a third."""
    if path in known:
        return known[path]
    if path in chain:
        loop = " -> ".join(p.name for p in (*chain[chain.index(path) :], path))
        raise ConfigError([Mistake(f"{path.name}: extends", None, f"extends itself: {loop}")])
    if len(chain) >= DEEPEST:
        why = f"the chain of files that extend each other is too long; permitted: {DEEPEST}"
        raise ConfigError([Mistake(f"{path.name}: extends", None, why)])
    own = anchor(_tables(path), path.parent)
    merged: Tables = {}
    for base in _bases(own.pop("extends", []), path):
        merged = _extended(merged, _read(base, (*chain, path), known))
    known[path] = _extended(merged, own)
    return known[path]


def _tables(path: Path) -> Tables:
    try:
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise ConfigError([Mistake(str(path), None, f"has {size} bytes; permitted: {LARGEST_BYTES}")])
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([Mistake(str(path), None, f"cannot be read: {error}")]) from None
    return parse(text, path.name)


def _bases(extends: Any, path: Path) -> list[Path]:
    place = f"{path.name}: extends"
    if not isinstance(extends, list) or not all(isinstance(item, str) for item in extends):
        raise ConfigError([Mistake(place, extends, "must be a list of config names or paths")])
    found = {item: _find(item, path.parent) or _find(f"{item}.toml", path.parent) for item in extends}
    lost = [
        Mistake(place, item, f"no such file beside {path.name} or among: {', '.join(names())}")
        for item, base in found.items()
        if base is None
    ]
    if lost:
        raise ConfigError(lost)
    return [base for base in found.values() if base is not None]


def _find(reference: str, folder: Path) -> Path | None:
    """Return the file that a config in `folder` means: beside it, else among the project's own."""
    return file_at(folder / reference) or file_at(CONFIGS / reference)
