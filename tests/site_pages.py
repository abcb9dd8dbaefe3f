"""Hook of mkdocs for `make docs`: pages stay beside the code, and links to code lead to pages.

A linked source file becomes a page that shows it, and a linked folder without a README a page that
lists its files. In `nav` a glob stands for all pages that no other entry names and no earlier glob
has.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from markdown import Extension, Markdown
from markdown.preprocessors import Preprocessor
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
FLOORS = ("backplane", "boards", "configs", "levels", "tools")
LINK = re.compile(r"(?<=\]\()(?!https?:)[^)#\s]+(?=[)#])")
STATIC = (".gif", ".ipynb", ".png")
LANGUAGES = {".py": "python", ".toml": "toml", ".xml": "xml", ".yml": "yaml"}
GENERATED = "---\nsearch:\n  exclude: true\n---\n\n"


class ListLines(Preprocessor):
    """Puts an empty line before a list that follows a paragraph, as in many docstrings."""

    def run(self, lines: list[str]) -> list[str]:
        """Return the lines of a text without its code."""
        text = "\n".join(lines)
        return re.sub(r"^(?!- | |$)(.*)\n(?=- )", r"\1\n\n", text, flags=re.MULTILINE).split("\n")


class ListExtension(Extension):
    """Recognises lists as other readers of Markdown do."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802
        """Run after the extension that takes out blocks of code."""
        md.preprocessors.register(ListLines(md), "list_lines", 5)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the extension, to pages and docstrings."""
    config.markdown_extensions.append(ListExtension())  # type: ignore[arg-type]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Replace the files of mkdocs by the pages of the project and all that they link to."""
    beside_code = (page for floor in FLOORS for page in (ROOT / floor).rglob("*.md"))
    sources = [*ROOT.glob("*.md"), *beside_code]
    uris = sorted(source.relative_to(ROOT).as_posix() for source in sources)
    pages = [File(uri, str(ROOT), config.site_dir, use_directory_urls=False) for uri in uris]
    linked = {path for source in sources for path in _linked_paths(source)}
    config.nav = _expand(config.nav, uris, set(_named_pages(config.nav)))
    return Files([*pages, *(_show(path, config) for path in sorted(linked))])


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Point links to folders and source files at their pages."""
    folder = (ROOT / page.file.src_uri).parent
    return LINK.sub(lambda link: link[0] + _suffix(folder / link[0]), markdown)


def _linked_paths(source: Path) -> Iterator[Path]:
    """Yield the files and folders that a page links to and that need a page or a copy."""
    for link in LINK.findall(source.read_text()):
        path = (source.parent / link).resolve()
        is_page = path.suffix == ".md" or (path / "README.md").exists()
        if path.is_relative_to(ROOT) and path.exists() and not is_page:
            yield path


def _suffix(path: Path) -> str:
    """Return what must follow a link to a path."""
    if path.is_dir():
        return "/README.md"
    return ".md" if path.is_file() and path.suffix not in (".md", *STATIC) else ""


def _show(path: Path, config: MkDocsConfig) -> File:
    """Return a picture as it is, and a page for a source file or a folder."""
    uri = path.relative_to(ROOT).as_posix()
    if path.suffix in STATIC:
        # mkdocs would leave out files in hidden folders.
        level = InclusionLevel.INCLUDED
        return File(uri, str(ROOT), config.site_dir, use_directory_urls=False, inclusion=level)
    if path.is_dir():
        content = "\n".join(_list_files(path))
    else:
        content = f"~~~~{LANGUAGES.get(path.suffix, 'text')}\n{path.read_text()}\n~~~~"
    content = f"{GENERATED}# {uri}\n\n{content}\n"
    level = InclusionLevel.NOT_IN_NAV
    return File.generated(config, uri + _suffix(path), content=content, inclusion=level)


def _list_files(folder: Path) -> Iterator[str]:
    """Yield a line for each file of a folder, with the first line of its docstring."""
    for path in sorted(folder.iterdir()):
        if path.is_file() and not path.name.startswith((".", "__")):
            meaning = ast.get_docstring(ast.parse(path.read_text())) if path.suffix == ".py" else ""
            yield f"- `{path.name}`: {(meaning or '').partition(chr(10))[0]}".rstrip(": ")


def _named_pages(nav: Any) -> Iterator[str]:
    """Yield the pages and globs of a navigation."""
    if isinstance(nav, str):
        yield nav
    else:
        for entry in nav.values() if isinstance(nav, dict) else nav:
            yield from _named_pages(entry)


def _expand(nav: Any, uris: list[str], named: set[str]) -> Any:
    """Return a navigation with the pages of each glob in its place, and add them to `named`."""
    if isinstance(nav, dict):
        return {title: _expand(entry, uris, named) for title, entry in nav.items()}
    if isinstance(nav, str):
        return nav
    expanded = []
    for entry in nav:
        if isinstance(entry, str) and "*" in entry:
            found = [uri for uri in uris if fnmatch(uri, entry) and uri not in named]
            named.update(found)
            expanded += found
        else:
            expanded.append(_expand(entry, uris, named))
    return expanded
