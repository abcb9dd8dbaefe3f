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
def test_levels_use_nothing_whose_bits_depend_on_the_processor() -> None:
    found = [
        f"{path.relative_to(LEVELS)}:{node.lineno}: {ast.unparse(node)}"
        for path in sorted(LEVELS.rglob("*.py"))
        for text in [path.read_text()]
        for node in ast.walk(ast.parse(text))
        if depends_on_processor(node, has_poses="Pose" in text or "import pose" in text)
    ]
    assert not found


def depends_on_processor(node: ast.AST, has_poses: bool) -> bool:
    """Return True for uses of numpy's BLAS or vector code; a norm over an axis is neither."""
    match node:
        case ast.BinOp(op=ast.MatMult()) | ast.AugAssign(op=ast.MatMult()):
            return not has_poses  # they are joined with @, which MuJoCo does
        case ast.Call(ast.Attribute(attr="argsort"), keywords=given):
            # Of equal values, each vector unit has its own order.
            return "kind='stable'" not in map(ast.unparse, given)
        case ast.Call(ast.Attribute(ast.Name("np"), name)):
            return name in ELSEWHERE
        case ast.Call(ast.Attribute(ast.Attribute(ast.Name("np"), "linalg"), name), keywords=given):
            return name != "norm" or all(keyword.arg != "axis" for keyword in given)
        case ast.Call(ast.Attribute(attr="dot")):
            return True
    return False
