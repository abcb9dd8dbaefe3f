"""TOML text from outside, parsed within bounds: the time of a parse grows with the length of the
text alone.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any

MAX_DEPTH = 32
"""Limit on the parts of a key, on the nesting of tables and lists, and on chains of `extends`."""
INTEGER_BITS = 64
"""TOML's own limit; Python's integers have none."""
TOO_DEEP = f"nested too deeply; permitted: {MAX_DEPTH} levels"
TOO_LONG = f"integer too long; permitted: {INTEGER_BITS} bits"
# A string that does not end is matched too, so that the text is read once, whatever is in it.
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
    """Return the tables of TOML text.

    The depth of tables and lists and the length of integers are bounded by Python alone:
    `rack.boards.config.toml.parse` bounds them as a config needs it.

    Raises:
        tomllib.TOMLDecodeError: The text is not TOML.
        ValueError: A key has more than `MAX_DEPTH` parts, tables or lists are nested more deeply
            than Python can parse, or an integer has thousands of digits.
    """
    # The parser's time grows with the square of the parts of a key.
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
