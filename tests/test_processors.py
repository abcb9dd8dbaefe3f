"""One motion on every processor: what a rack does depends on no choice that a library makes at run
time."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest

from rack.boards import Rack
from rack.boards.config import load
from rack.boards.crate.line import TUNABLES
from tests.processes import run_to_end

pytestmark = pytest.mark.thorough

SECONDS = 9.0
"""Of `nasrem`: the plans, the way to the first object, the grasp, the way up with it."""
BLAS, NUMPY = "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES"
FOUND = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
"""Sets of instructions that this processor has, and for which numpy has code of its own; each
includes the last."""
PROCESSORS: dict[str, dict[str, str]] = {
    "this one": {},
    "without AVX-512": {BLAS: "Haswell", NUMPY: " ".join(FOUND[1:])},
    "without AVX": {BLAS: "Nehalem", NUMPY: " ".join(FOUND)},
    "of 2004": {
        BLAS: "Prescott",
        NUMPY: " ".join(FOUND),
        TUNABLES: "glibc.cpu.hwcaps=-AVX512F,-AVX2,-AVX,-FMA,-FMA4",
    },
}
"""Environments that let the libraries take this processor for another. Boards see them as they are
set here: only the choice of the C library, of which a level can't be independent, is made by the
crate."""
ARITHMETIC = """
import hashlib, math
import numpy as np
from levels import algebra
rng = np.random.default_rng(1)
found = []
for n in (3, 6, 7, 12):
    for _ in range(50):
        square, tall, x = rng.normal(size=(n, n)), rng.normal(size=(6, n)), rng.normal(size=n)
        found += [algebra.mat_vec(square, x), algebra.transposed_mat_vec(tall, tall[:, 0]), algebra.gram(tall)]
        found += [algebra.solve(algebra.gram(square), x), [algebra.norm(x)], algebra.apply_elementwise(math.tanh, tall)]
        found += [tall.sum(axis=0), tall.sum(axis=1), [x.sum()], np.linalg.norm(tall, axis=1), np.sqrt(np.abs(x))]
print(hashlib.sha256(b"".join(np.asarray(value).tobytes() for value in found)).hexdigest())
"""
"""What levels calculate with, and what numpy is trusted with."""


def test_what_levels_calculate_with_gives_equal_bits_on_every_processor() -> None:
    digests = set()
    for settings in PROCESSORS.values():
        environment = {**os.environ, TUNABLES: "glibc.cpu.hwcaps=-FMA,-FMA4", **settings}
        command = [sys.executable, "-c", ARITHMETIC]
        digests.add(run_to_end(command, 60, env=environment, check=True).stdout)
    assert len(digests) == 1


def test_a_rack_moves_the_same_on_every_processor(
    rack_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load("nasrem", [f"name={rack_name}", "clock.mode=lockstep"])
    digests = {}
    for processor, settings in PROCESSORS.items():
        with monkeypatch.context() as environment:
            for name, value in settings.items():
                environment.setenv(name, value)
            with Rack(config) as rack:
                digests[processor] = rack.run(SECONDS).digest
    assert len(set(digests.values())) == 1, digests
