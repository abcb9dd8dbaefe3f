"""Buses for tests of faults."""

from tests.backplane.conftest import make_bus  # noqa: F401  a fixture
