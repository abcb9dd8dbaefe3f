"""Products, solutions and lengths with one order of operations, and that levels use no others."""

from __future__ import annotations

import ast
import math
from pathlib import Path

import numpy as np
import pytest

from rack.levels import algebra

LEVELS = Path(algebra.__file__).parent
RNG = np.random.default_rng(3)
STEMS = ("sin", "cos", "tan", "sinh", "cosh", "tanh")
PRODUCTS = "dot vdot inner vecdot matmul matvec tensordot power float_power argsort"
POWERS = "exp exp2 expm1 log log2 log10 log1p cbrt atan2 arctan2 logaddexp"
ELSEWHERE = {*PRODUCTS.split(), *POWERS.split()} | {
    name for stem in STEMS for name in (stem, f"a{stem}", f"arc{stem}")
}
"""Functions of numpy whose results depend on the processor: BLAS, vector code, ties in sorts."""


@pytest.mark.parametrize("joints", [1, 6, 7])
def test_results_are_those_of_linear_algebra(joints: int) -> None:
    shapes = (joints, joints), (6, joints), joints, 6
    square, tall, x, y = (RNG.normal(size=shape) for shape in shapes)
    inertia = square.T @ square + np.eye(joints)
    assert algebra.mat_vec(tall, x) == pytest.approx(tall @ x)
    assert algebra.transposed_mat_vec(tall, y) == pytest.approx(tall.T @ y)
    assert algebra.gram(tall) == pytest.approx(tall.T @ tall)
    before = inertia.copy(), x.copy()
    assert algebra.solve(inertia, x) == pytest.approx(np.linalg.solve(inertia, x))
    # It leaves its arguments alone.
    assert np.array_equal(inertia, before[0])
    assert np.array_equal(x, before[1])
    assert algebra.norm(x) == pytest.approx(np.linalg.norm(x))
    curved = [[math.tanh(value) for value in row] for row in tall]
    assert np.array_equal(algebra.apply_elementwise(math.tanh, tall), curved)


@pytest.mark.slow
def test_levels_call_nothing_whose_bits_depend_on_the_processor() -> None:
    found = [
        f"{path.relative_to(LEVELS)}:{node.lineno}: {ast.unparse(node)}"
        for path in sorted(LEVELS.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and depends_on_processor(node)
    ]
    assert not found


@pytest.mark.slow
def test_levels_multiply_no_arrays_with_an_operator() -> None:
    # Poses are joined with @, which MuJoCo does.
    found = [
        f"{path.relative_to(LEVELS)}:{node.lineno}: {ast.unparse(node)}"
        for path in sorted(LEVELS.rglob("*.py"))
        if "Pose" not in (text := path.read_text()) and "import pose" not in text
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult)
    ]
    assert not found


def depends_on_processor(call: ast.Call) -> bool:
    """Return True for calls of numpy's BLAS or vector code; a norm over an axis is neither."""
    match call.func:
        case ast.Attribute(attr="argsort"):  # of equal values, each vector unit has its own order
            return "kind='stable'" not in map(ast.unparse, call.keywords)
        case ast.Attribute(value=ast.Name(id="np"), attr=name):
            return name in ELSEWHERE
        case ast.Attribute(value=ast.Attribute(value=ast.Name(id="np"), attr="linalg"), attr=name):
            return name != "norm" or all(keyword.arg != "axis" for keyword in call.keywords)
        case ast.Attribute(attr="dot"):
            return True
    return False
