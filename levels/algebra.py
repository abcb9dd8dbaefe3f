"""Arithmetic that gives the same bits on every processor.

A lockstep run repeats bit for bit, even on another machine. Numpy does not guarantee that: its BLAS
(`@`, `np.dot`, `np.linalg`) sums in an order that depends on the processor's vector unit, and many
of its functions (`tanh`, `exp`, `arctan2`, `arccos`, `**` with exponents other than 2) have a
variant for each vector unit. Levels use the following instead:

- Products, solutions and lengths come from MuJoCo. It is compiled once, makes no choices at run
  time, and is about as fast as BLAS for a few joints.
- Transcendental functions come from `math`, which calls the C library. The crate selects the same
  variant for all boards.

Numpy's elementwise + - * / and sqrt are exact by IEEE 754. Its sums, norms over an axis, and
sorting of values use the same order on all x86-64 processors. Alternative considered: `np.einsum`
has a fixed order as well, but takes twice the time.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int_]
Mask = NDArray[np.bool_]

LEAST_PIVOT = 1e-12
"""Diagonal element of a Cholesky factor below which the matrix is treated as singular."""


def mat_vec(matrix: Array, vector: Array) -> Array:
    """Return `matrix` (m, n) times `vector` (n,)."""
    product = np.empty(len(matrix))
    mujoco.mju_mulMatVec(product, matrix, vector)
    return product


def transposed_mat_vec(matrix: Array, vector: Array) -> Array:
    """Return the transpose of `matrix` (m, n) times `vector` (m,)."""
    product = np.empty(matrix.shape[1])
    mujoco.mju_mulMatTVec(product, matrix, vector)
    return product


def gram(matrix: Array) -> Array:
    """Return the (n, n) product of the transpose of `matrix` (m, n) and `matrix`."""
    columns = matrix.shape[1]
    product = np.empty((columns, columns))
    mujoco.mju_mulMatTMat(product, matrix, matrix)
    return product


def solve(matrix: Array, vector: Array) -> Array:
    """Solve `matrix` x = `vector` for x (n,).

    `matrix` (n, n) must be symmetric and positive definite, like an inertia matrix.
    """
    factor = matrix.copy()
    solution = np.empty(len(vector))
    mujoco.mju_cholFactor(factor, LEAST_PIVOT)
    mujoco.mju_cholSolve(solution, factor, vector)
    return solution


def norm(vector: ArrayLike) -> float:
    """Return the Euclidean length of `vector` (n,)."""
    return float(mujoco.mju_norm(vector))


def apply_elementwise(function: Callable[[float], float], values: Array) -> Array:
    """Apply `function`, such as `math.tanh`, to each element; return an array of the same shape."""
    return np.fromiter(map(function, values.ravel().tolist()), float, values.size).reshape(
        values.shape
    )
