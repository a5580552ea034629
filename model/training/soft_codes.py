"""Soft targets for trajectory codes.

Many code sequences spell nearly the same trajectory. Instead of one winner per stage, a stage's target is
a distribution over codewords by their distance, and the code fed on is drawn from it: later stages then
learn to correct whatever earlier ones chose. A small model learns far faster from this than from winners.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray
from looktwice.model.network.codec import TrajectoryCodec

_SOFTNESS: Final = 0.5
"""Width of the target, in mean squared distances to the nearest codeword: about four codes share a target."""


class SoftTarget(NamedTuple):
    """What the codes of one trajectory should be.

    Attributes:
        codes: int64 [6], drawn.
        shares: float32 [6, K], the distributions they were drawn from.
        errors_m: float32 [6, K], how far off, behind the codes before it, a codeword leaves the trajectory:
            root mean square metres over the horizon.
    """

    codes: npt.NDArray[np.int64]
    shares: FloatArray
    errors_m: FloatArray


class SoftCodes:
    """Draws soft targets for one codec; ``vectors`` [n, d] from `TrajectoryCodec.vectors` set their width."""

    def __init__(self, codec: TrajectoryCodec, vectors: FloatArray) -> None:
        self._books = codec.books
        self._squares = (codec.books**2).sum(axis=-1)
        rest = vectors[np.random.default_rng(0).permutation(len(vectors))[:2000]].copy()
        widths = []
        for book, squares in zip(self._books, self._squares, strict=True):
            cost = squares - 2 * rest @ book.T
            nearest = cost.argmin(axis=1)
            rest -= book[nearest]
            widths.append(_SOFTNESS * float((rest**2).sum(axis=1).mean()))
        self._widths = np.maximum(widths, 1e-6)

    def draw(self, vector: FloatArray, random: np.random.Generator, nearest: int = 0) -> SoftTarget:
        """A target for one vector [d]; in the first ``nearest`` stages it is the nearest code alone."""
        stages, size = self._squares.shape
        codes, shares = np.empty(stages, np.int64), np.empty((stages, size), np.float32)
        errors = np.empty((stages, size), np.float32)
        rest = vector.astype(np.float32)
        for stage, book in enumerate(self._books):
            squares = self._squares[stage] - 2 * book @ rest
            errors[stage] = np.sqrt(np.maximum(squares + rest @ rest, 0.0) / FUTURE_STEPS)
            cost = squares / self._widths[stage]
            weights = cost == cost.min() if stage < nearest else np.exp(cost.min() - cost)
            shares[stage] = weights / weights.sum()
            codes[stage] = np.searchsorted(np.cumsum(shares[stage]), random.random() * shares[stage].sum())
            codes[stage] = min(codes[stage], size - 1)
            rest = rest - book[codes[stage]]
        return SoftTarget(codes, shares, errors)
