"""Reader that checks the XML files of a model before MuJoCo reads them.

The files are not trusted. Every mistake is one `RobotError`, found in bounded time and memory.
MuJoCo receives the text that was checked here, and opens no XML file itself.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path, PureWindowsPath
from typing import NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat

from rack.backplane.regular_file import check_regular_file, read_regular_file
from rack.levels.errors import RobotError

MAX_MODEL_BYTES = 16_000_000
"""Maximum size of all XML files of a model."""
MAX_ASSET_BYTES = 200_000_000
"""Maximum size of one mesh, texture or height field."""
MAX_PIXELS = 70_000_000
"""Maximum number of pixels of an image. A small file may exceed memory when decoded."""
MAX_DEPTH = 300
"""Maximum nesting depth of elements."""
MAX_FILES = 100
"""Maximum number of XML files of a model. A file that includes itself exceeds it."""
MAX_PARTS = 6_000
"""Maximum number of parts of a model, including all replicas.

The time in which MuJoCo reads them grows with the square of their number.
"""
PART_TAGS = ("body", "composite", "flexcomp", "geom", "joint", "link", "site")
REPEATING_TAGS = ("replicate", "composite", "flexcomp")
MAX_GRID_CELLS = 4_000_000
"""Maximum number of cells of a height field or texture.

MuJoCo allocates them while it parses (20000 x 20000 takes 10 s).
"""
GRID_ATTRIBUTES = (("nrow", "ncol"), ("width", "height"))
PNG = b"\x89PNG\r\n\x1a\n"
XACRO_HINT = "expand it first: xacro IN > arm.urdf"
VECTOR_ATTRIBUTES = ("xyz", "rpy", "size", "scale")
"""Attributes of three numbers."""
NUMBER_ATTRIBUTES = (
    *VECTOR_ATTRIBUTES,
    *("ixx", "ixy", "ixz", "iyy", "iyz", "izz", "value", "radius", "length", "lower", "upper"),
    *("effort", "velocity", "damping", "friction", "multiplier", "offset"),
)
"""Numeric attributes in links and joints of a URDF."""
LIMIT_ENDINGS = ("range", "cutoff", "effort")
"""Endings of attribute names whose value may be infinite, which means no limit."""
MAX_VELOCITY = 1e9
"""Velocity that no joint reaches, rad/s or m/s."""


class _Place(NamedTuple):
    """Place of an element in the model's files."""

    file: Path  # file that contains the element
    owner: str  # kind and name of the nearest named element around it
    copies: float  # number of copies that replication makes of the element
    depth: int  # nesting depth of the element


class ModelReader:
    """Reads the XML file of a model, and all files that it includes or attaches.

    Elements and attributes with a namespace prefix are left out, because they are for other
    programs.

    Attributes:
        root: Root of the model's main file.
        texts: Content of all files, the main file first, keyed by the names under which MuJoCo
            finds them.
    """

    def __init__(self, path: Path) -> None:
        """Read the files of a model.

        Args:
            path: The model's main file.

        Raises:
            RobotError: A file is missing, malformed, too large or not a regular file, or includes a
                file outside its folder; a number is invalid; or there are too many parts.
        """
        self._files: dict[str, tuple[Path, ElementTree.Element]] = {}
        self._models: dict[str | None, str] = {}  # names of attached files
        self._assets: set[tuple[Path, str]] = set()  # folder of a model, and a file it names
        self._folders = {""}  # folders of assets
        self._bytes = 0
        self._parts = 0.0
        self.root = self._read_file(path, path.resolve().parent)
        self._check_element(self.root, _Place(path, "", 1.0, 1))
        if self.root.tag == "mujoco":
            self._check_assets(path)
        self.texts = {
            name: ElementTree.tostring(root, encoding="unicode").encode()
            for name, (_, root) in self._files.items()
        }

    def _read_file(self, path: Path, folder: Path) -> ElementTree.Element:
        """Read a file of a model in `folder`, and the files to which it refers."""
        try:
            text = read_regular_file(path, MAX_MODEL_BYTES - self._bytes)
            root = parse_xml(text)
        except FileNotFoundError:
            raise RobotError(f"model '{path}': no such file") from None
        except OSError as problem:
            raise RobotError(f"model '{path}': {problem.strerror}") from None
        except expat.ExpatError as problem:
            raise RobotError(f"model '{path}': malformed XML: {problem}") from None
        except (ValueError, LookupError) as problem:
            raise RobotError(f"model '{path}': {problem}") from None
        self._bytes += len(text)
        self._files[f"{len(self._files)}.xml"] = (path, root)
        if len(self._files) > MAX_FILES:
            raise RobotError(
                f"model '{path}': more than {MAX_FILES} files are included; does one include"
                " itself?"
            )
        for element in root.iter():
            if element.tag not in ("include", "model"):
                self._folders |= {value for key, value in element.items() if key.endswith("dir")}
                files = {value for key, value in element.items() if key.startswith("file")}
                self._assets |= {(folder, file) for file in files if file}
            elif "file" in element.attrib:
                self._read_reference(element, path, folder)
        return root

    def _read_reference(self, element: ElementTree.Element, path: Path, folder: Path) -> None:
        """Read the file that an element names, and set this name to the file's key in `texts`.

        Args:
            element: Includes the file, or declares it as a model to attach.
            path: File that contains the element.
            folder: Folder of the model.
        """
        name = element.get("file", "")
        places = (folder / name, path.resolve().parent / name)
        target = find_file(places) or places[0]
        text_name = f"{len(self._files)}.xml"
        if element.tag == "model":
            self._models[element.get("name")] = text_name
            folder = target.resolve().parent
        elif not target.resolve().is_relative_to(folder):
            raise RobotError(f"model '{path}': include '{name}' leaves the model's folder")
        self._read_file(target, folder)
        # MuJoCo finds texts by the last part of their path.
        element.set("file", str(Path(name).with_name(text_name)))

    def _check_element(self, element: ElementTree.Element, place: _Place) -> None:
        """Check an element, its children and the files that it includes.

        Also count the bodies, joints, geoms and sites among them, including replicas.
        """
        file, owner, copies, depth = place
        tag = element.tag
        if name := element.get("name"):
            owner = f"{tag} '{name}'"
        for mistake in _find_mistakes(element, owner, self.root.tag == "robot"):
            raise RobotError(f"model '{file}': {mistake}")
        if tag in REPEATING_TAGS:
            copies *= math.prod(max(1.0, n) for n in parse_numbers(element.get("count", "")))
        self._parts += copies * (tag in PART_TAGS)
        if self._parts > MAX_PARTS:
            raise RobotError(
                f"model '{file}': more than {MAX_PARTS} bodies, joints, geoms and sites, with all"
                " replicas"
            )
        if depth > MAX_DEPTH:
            raise RobotError(f"model '{file}': more than {MAX_DEPTH} elements within each other")
        for child in element:
            self._check_element(child, _Place(file, owner, copies, depth + 1))
        refers = {"include": element.get("file"), "attach": self._models.get(element.get("model"))}
        if text_name := refers.get(tag):
            inner, root = self._files[text_name.rpartition("/")[2]]
            self._check_element(root, _Place(inner, owner, copies, depth + 1))

    def _check_assets(self, model: Path) -> None:
        """Check that meshes, images and height fields are regular files of bounded size."""
        for folder, name in self._assets:
            places = [folder / place for place in sorted(self._folders)]
            # MuJoCo also strips Windows paths.
            asset = PureWindowsPath(name)
            files = [
                place / file_name
                for place in places
                for file_name in (asset.as_posix(), asset.name)
            ]
            existing = [file for file in files if find_file([file])]
            if not existing:
                looked = ", ".join(map(str, places))
                raise RobotError(f"model '{model}': no file '{name}'; looked for in {looked}")
            for file in existing:
                check_asset(file, model)


def parse_xml(text: bytes) -> ElementTree.Element:
    """Parse a file, and leave out elements and attributes with a prefix, even an undeclared one.

    Every start tag stays on its line, because MuJoCo reports the line in its messages.

    Raises:
        ExpatError: The text is malformed.
        ValueError: The text declares entities, or contains unexpanded xacro.
    """
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    foreign = 0  # nesting depth within an element with a prefix
    line = 1

    def start(tag: str, attributes: dict[str, str]) -> None:
        """Add an element at its start tag, unless it or an element around it has a prefix."""
        nonlocal foreign, line
        prefix, _, name = tag.rpartition(":")
        if prefix == "xacro" and name not in ("property", "arg"):
            raise ValueError(f"line {parser.CurrentLineNumber} holds <{tag}>; {XACRO_HINT}")
        if foreign or prefix:
            foreign += 1
            return
        builder.data("\n" * (parser.CurrentLineNumber - line))
        line = parser.CurrentLineNumber
        builder.start(tag, {key: value for key, value in attributes.items() if ":" not in key})

    def end(tag: str) -> None:
        """Complete an element at its end tag."""
        nonlocal foreign
        if foreign:
            foreign -= 1
        else:
            builder.end(tag)

    def refuse(*_: object) -> None:
        """Refuse the declaration of an entity."""
        raise ValueError(f"line {parser.CurrentLineNumber} declares an entity; write its text out")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.EntityDeclHandler = refuse
    parser.Parse(text, True)
    return builder.close()


def find_file(paths: Iterable[Path]) -> Path | None:
    """Return the first path that exists, or None."""
    for path in paths:
        with suppress(OSError):
            path.stat()
            return path
    return None


def check_asset(file: Path, model: Path) -> None:
    """Check that an asset of a model is a regular file, and not too large even when decoded.

    Raises:
        RobotError: The asset is not a regular file, or it is too large.
    """
    try:
        check_regular_file(file, MAX_ASSET_BYTES)
        with file.open("rb") as opened:
            head = opened.read(24)
    except OSError as problem:
        raise RobotError(f"model '{model}': '{file}': {problem.strerror}") from None
    if head.startswith(PNG) and math.prod(struct.unpack(">II", head[16:])) > MAX_PIXELS:
        raise RobotError(f"model '{model}': '{file}': more than {MAX_PIXELS} pixels")


def _find_mistakes(element: ElementTree.Element, owner: str, is_urdf: bool) -> Iterator[str]:
    """Yield descriptions of mistakes in an element, such as an invalid number or too large a grid.

    Args:
        element: The element.
        owner: Kind and name of the nearest named element.
        is_urdf: True if the file is a URDF.
    """
    place = owner if "name" in element.attrib else f"<{element.tag}>" + f" of {owner}" * bool(owner)
    is_part = owner.startswith(("link", "joint"))
    for key, value in element.items():
        values = parse_numbers(value)
        is_wrong = key != "name" and not all(
            math.isfinite(x) or (math.isinf(x) and key.endswith(LIMIT_ENDINGS)) for x in values
        )
        valid = "finite numbers"
        if is_urdf:
            is_wrong |= (
                not len(value.split()) == len(values) == (3 if key in VECTOR_ATTRIBUTES else 1)
            )
            is_wrong |= key == "velocity" and not 0.0 <= min(values, default=0.0) < MAX_VELOCITY
            is_wrong &= is_part and key in NUMBER_ATTRIBUTES
            valid = (
                "3 finite numbers" if key in VECTOR_ATTRIBUTES else "a finite number, such as 2.5"
            )
            valid += f", from 0 to {MAX_VELOCITY:g}" * (key == "velocity")
        if is_wrong:
            hint = f"; {XACRO_HINT}" * ("$" in value)
            yield f"{place}: {key} = '{value[:60]}'; it must be {valid}{hint}"
    for keys in [(key,) for key in element.attrib] if element.tag == "size" else GRID_ATTRIBUTES:
        cells = math.prod(max(parse_numbers(element.get(key, "0")), default=0.0) for key in keys)
        if cells > MAX_GRID_CELLS:
            yield f"{place}: {' x '.join(keys)} = {cells:g}; at most {MAX_GRID_CELLS}"


def parse_numbers(text: str) -> list[float]:
    """Return the words of an attribute that are numbers. As in C, "nan(7)" is a number."""
    values = []
    for word in text.split():
        with suppress(ValueError):
            values.append(float(word.partition("(")[0]))
    return values
