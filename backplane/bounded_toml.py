"""Parser for TOML text from outside, in time proportional to the length of the text."""

from __future__ import annotations

import re
import tomllib
from typing import Any

MAX_DEPTH = 32
"""Maximum number of parts of a key, nested tables or lists, and chained `extends`."""
INTEGER_BITS = 64
"""Size of a TOML integer. Python's own integers have no limit."""
TOO_DEEP = f"nested too deeply: the limit is {MAX_DEPTH} levels"
TOO_LONG = f"integer too long: the limit is {INTEGER_BITS} bits"
# An unterminated string matches too, so any text is scanned only once.
_QUOTED = re.compile(
    r'"""(?:[^"\\]++|\\.|"{1,2}(?!"))*+"{0,5}'
    r"|'''(?:[^']++|'{1,2}(?!'))*+'{0,5}"
    r'|"(?:[^"\\\n]++|\\.)*+"?'
    r"|'[^'\n]*+'?"
    r"|#[^\n]*+",
    re.DOTALL,
)
_KEYS = re.compile(r"[\w\-. \t]++")


def load_toml(text: str) -> dict[str, Any]:
    """Parse TOML text into tables.

    The stricter limits of configs on nesting and on the size of integers are not checked here.
    `rack.boards.config.toml.parse` checks them.

    Raises:
        tomllib.TOMLDecodeError: The text is not TOML.
        ValueError: A key has more than `MAX_DEPTH` parts, tables or lists are nested more
            deeply than Python can parse, or an integer has thousands of digits.
    """
    # The time that the parser takes grows with the square of the number of parts of a key.
    keys = _KEYS.findall(_QUOTED.sub("q", text))
    if any(key.count(".") >= MAX_DEPTH for key in keys):
        raise ValueError(TOO_DEEP)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    except ValueError:
        raise ValueError(TOO_LONG) from None
