"""An ego that strays from its line now and then, so that scenes show how to come back.

Whoever learns from an expert that never errs does not know what to do after an error of his own (DAgger,
https://arxiv.org/abs/1011.0686). The way out is not to be learned: no scene's future holds one.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from looktwice.clients.metadrive.world.actors import STEP_S, Drift, Vehicle

_APART_S: Final = (8.5, 12.0)
"""Longer than a scene's future, so that scenes lie between two of them."""
_FIRST_S: Final = (2.0, 6.0)
_OFFSET_M: Final = (0.3, 1.3)
_OUT_S: Final = (0.9, 1.8)
_BACK_S: Final = (2.0, 3.5)
_SLOWEST: Final = 3.0
_STRAYING: Final = 0.6
"""This much of the way out is nobody's to learn; behind it, the heading alone carries the car on."""


class Drifter:
    """Makes a vehicle stray, by a chance of its own."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 11])
        self._next_s = float(self._rng.uniform(*_FIRST_S))

    def step(self, time_s: float, car: Vehicle) -> None:
        """Begin to stray when it is time, the car rolls, and it is not changing lanes."""
        if time_s < self._next_s or car.speed < _SLOWEST or car.shift is not None or car.drift is not None:
            return
        rng = self._rng
        self._next_s = time_s + float(rng.uniform(*_APART_S))
        offset = float(rng.uniform(*_OFFSET_M)) * float(rng.choice([-1.0, 1.0]))
        out, back = (car.speed * float(rng.uniform(*span)) for span in (_OUT_S, _BACK_S))
        car.drift = Drift(car.s, offset, out, back)


def strays(car: Vehicle) -> bool:
    """Whether a vehicle is on its way out, or does not heed what it should."""
    drift = car.drift
    out = drift is not None and car.s + car.speed * STEP_S < drift.start_s + _STRAYING * drift.out
    return out or car.heedless
