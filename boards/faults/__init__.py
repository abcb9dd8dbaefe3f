"""Fault kinds, one record each, and the steps that carry them out.

`KINDS` contains the kinds that this process knows. `rack.boards.faults.kind` explains how to add
one.
"""

import rack.boards.faults.kinds  # noqa: F401  adds the project's own kinds
from rack.boards.faults.kind import KINDS, Consequence, Kind, Kinds, Parameter

__all__ = ["KINDS", "Consequence", "Kind", "Kinds", "Parameter"]
