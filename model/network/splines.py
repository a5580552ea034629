"""Smooth curves over the planning horizon: cubic B-splines that begin as they must."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def clamped_basis(times: Array, knots: Array, degree: int = 3) -> Array:
    """Values [t, k] of the clamped B-spline basis over ``knots`` (ascending, ends included) at ``times``.

    Cox-de Boor recursion. The first function alone is not 0 at the first knot, the first two alone have a
    slope there: leaving them out fixes value, or value and slope, to zero.
    """
    padded = np.concatenate([[knots[0]] * degree, knots, [knots[-1]] * degree])
    # Half-open intervals; the last one takes the end of the horizon in.
    inside = (times[:, None] >= padded[:-1]) & (times[:, None] < padded[1:])
    last = len(knots) + degree - 2
    inside[times >= knots[-1]] = False
    inside[times >= knots[-1], last] = True
    basis = inside.astype(np.float64)
    for order in range(1, degree + 1):
        functions = basis.shape[1] - 1
        left, right = padded[:functions], padded[order : order + functions]
        rise = _ratio(times[:, None] - left, right - left)
        left, right = padded[1 : 1 + functions], padded[order + 1 : order + 1 + functions]
        fall = _ratio(right - times[:, None], right - left)
        basis = rise * basis[:, :-1] + fall * basis[:, 1:]
    return basis


def _ratio(numerator: Array, denominator: Array) -> Array:
    """The quotient, 0 where a knot is repeated."""
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=denominator > 0)
