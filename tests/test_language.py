"""Texts of the product avoid the patterns that made them hard to read.

ruff checks the form of docstrings. These patterns are not a matter of form: each made a reader
guess what the sentence is about.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted(
    path
    for folder in ("backplane", "boards", "configs", "levels", "tools")
    for path in (ROOT / folder).rglob("*.py")
)
PATTERNS = {
    "a clause in place of a noun": re.compile(r"(What|Where|Who|How|Which|Whose) (?!.*\?)"),
    "a value and its meaning without a sentence": re.compile(r".*; (None|empty|0|-1|False|True): "),
    "'say whether' in place of 'return True if'": re.compile(r".*\bSay whether\b"),
}
"""Matched from the beginning of a text."""
COMMENT = re.compile(r"(?:^|\s)# *(.*)")
SHORTEST_MESSAGE = 6
"""A string of at least as many words is read by people."""


def texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the words of each docstring, comment and message of a file."""
    documentation = set()
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(ast.Constant(str(text)) as constant):
                documentation.add(constant)
                yield node.lineno, " ".join(text.split())
            case ast.Constant(str(text)) if node not in documentation:
                if len(text.split()) >= SHORTEST_MESSAGE:
                    yield node.lineno, " ".join(text.split())
    for number, line in enumerate(source.splitlines(), 1):
        if comment := COMMENT.search(line):
            yield number, comment[1]


def hits(source: str) -> list[str]:
    return [
        f"{line}: {name}: {text}"
        for line, text in texts(source)
        for name, pattern in PATTERNS.items()
        if pattern.match(text)
    ]


@pytest.mark.slow
def test_texts_avoid_patterns_that_hide_their_subject() -> None:
    assert not [
        f"{path.relative_to(ROOT)}:{hit}" for path in SOURCES for hit in hits(path.read_text())
    ]


@pytest.mark.parametrize(
    "source",
    [
        '"""What a sample may be off by."""',
        "x = 1\n# Say whether it is new.",
        "x = 1  # ticks; None: for ever",
        'raise ValueError("the bound in ticks of a cycle; 0: none is given")',
    ],
)
def test_each_pattern_is_noticed(source: str) -> None:
    assert hits(source)


def test_a_question_is_no_hit() -> None:
    assert not hits('"""What does a cycle cost?"""')


def missing_attributes(source: str) -> list[str]:
    """Return names in `Attributes:` sections that their classes do not have."""
    missing = []
    for owner in ast.walk(ast.parse(source)):
        if not isinstance(owner, ast.ClassDef):
            continue
        _, _, section = (ast.get_docstring(owner) or "").partition("Attributes:\n")
        if not section:
            continue
        names = {node.name for node in ast.walk(owner) if isinstance(node, ast.FunctionDef)}
        for node in ast.walk(owner):
            match node:
                case ast.Attribute(_, name, ast.Store()) | ast.Name(name, ast.Store()):
                    names.add(name)
        listed = re.findall(r"^    (\w+)(?:, (\w+))?:", section.partition("\n\n")[0], re.MULTILINE)
        missing += [
            f"{owner.name}.{name}" for pair in listed for name in pair if name and name not in names
        ]
    return missing


@pytest.mark.slow
def test_docstrings_of_classes_list_attributes_that_exist() -> None:
    assert not [
        f"{path.relative_to(ROOT)}: {name}"
        for path in SOURCES
        for name in missing_attributes(path.read_text())
    ]


def test_an_attribute_that_is_documented_but_missing_is_noticed() -> None:
    section = "Attributes:\n        a: One.\n        b, c: Two.\n"
    source = f'class A:\n    """B.\n\n    {section}    """\n    a = 1\n    b = 1\n'
    assert missing_attributes(source) == ["A.c"]
