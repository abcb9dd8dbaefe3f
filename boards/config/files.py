"""Config files: found by name or path, `extends` merged in, the paths they hold made absolute."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from boards.errors import ConfigError, Mistake

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
"""The project's own configs, beside this package in a checkout and in an installation."""
FAULTS = CONFIGS / "faults"
"""Scripts of faults, for `--faults`."""
WHOLE_TABLES = ("robot", "scene", "task")
"""Half of one arm is no arm: these are replaced as a whole where others are merged key by key."""

Tables = dict[str, Any]


def read(name_or_path: str | Path) -> Tables:
    """Return the tables of a config and of all that it extends, merged.

    A name means a config of the project; what holds a '/' or ends in '.toml' is a path. Raises `ConfigError`.
    """
    return _read(_path(name_or_path, "config", CONFIGS), ())


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
    path = Path(text).expanduser() if is_path else folder / f"{text}.toml"
    if not path.is_file():
        raise ConfigError([Mistake(place, text, f"no such file; by name: {', '.join(names(folder))}; or a path")])
    return path.resolve()


def parse(text: str, place: str = "config") -> Tables:
    """Return the tables of TOML text. Raises `ConfigError` with the line that is not TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([Mistake(place, None, f"not TOML: {error}")]) from None


def merge(base: Tables, top: Tables, whole: tuple[str, ...] = ()) -> Tables:
    """Return `base` with `top` over it, table by table; the tables in `whole` are replaced."""
    merged = dict(base)
    for key, value in top.items():
        if key not in whole and isinstance(value, dict) and isinstance(base.get(key), dict):
            value = merge(base[key], value)
        merged[key] = value
    return merged


def anchor(tables: Tables, folder: Path) -> Tables:
    """Return the tables with their paths absolute: relative to `folder`, a bundled model also to configs/."""
    anchored = dict(tables)
    robot, own = tables.get("robot"), tables.get("python_path")
    if isinstance(robot, dict) and isinstance(robot.get("model"), str):
        anchored["robot"] = {**robot, "model": str(_find(robot["model"], folder) or folder / robot["model"])}
    if isinstance(own, list) and all(isinstance(item, str) for item in own):
        anchored["python_path"] = [str((folder / item).resolve()) for item in own]
    return anchored


def _read(path: Path, chain: tuple[Path, ...]) -> Tables:
    if path in chain:
        loop = " -> ".join(p.name for p in (*chain[chain.index(path) :], path))
        raise ConfigError([Mistake(f"{path.name}: extends", None, f"extends itself: {loop}")])
    own = anchor(_tables(path), path.parent)
    merged: Tables = {}
    for base in _bases(own.pop("extends", []), path):
        merged = merge(merged, _read(base, (*chain, path)), WHOLE_TABLES)
    return merge(merged, own, WHOLE_TABLES)


def _tables(path: Path) -> Tables:
    try:
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
    for path in (folder / reference, CONFIGS / reference):
        if path.is_file():
            return path.resolve()
    return None
