"""Fields that many messages have: numbers, flags, ticks, and values by joint."""

from __future__ import annotations

from rack.backplane.message import Field


def number(name: str, meaning: str) -> Field:
    """Return a field for a count or a serial."""
    return Field(name, "u4", "1", meaning)


def short_count(name: str, meaning: str) -> Field:
    """Return a field for a small count."""
    return Field(name, "u2", "1", meaning)


def row(name: str, meaning: str) -> Field:
    """Return a field for a row of a table; -1: none."""
    return Field(name, "i2", "1", meaning)


def flag(name: str, meaning: str, *shape: int | str) -> Field:
    """Return a field that is 1 or 0, or such ones."""
    return Field(name, "u1", "1", meaning, shape)


def tick(name: str, meaning: str) -> Field:
    """Return a field for a tick."""
    return Field(name, "i8", "tick", meaning)


def real(name: str, unit: str, meaning: str, *shape: int | str) -> Field:
    """Return a field for a real number, or for such ones."""
    return Field(name, "f8", unit, meaning, shape)


def by_joint(name: str, unit: str, meaning: str) -> Field:
    """Return a field with a number for each joint."""
    return real(name, unit, meaning, "joints")
